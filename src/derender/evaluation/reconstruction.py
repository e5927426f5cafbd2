"""How well a model renders pictures it has not seen, beside the mean picture.

A low error alone proves nothing about geometry (a copied picture has none): read it with
evaluation/geometry.py. SSIM is in evaluation/structural_similarity.py. Leaves out learned similarities.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from derender.evaluation.structural_similarity import WINDOW, masked_ssim
from derender.features import Progress, map_batches


@dataclass(frozen=True)
class ReconstructionScores:
    """Errors inside the mask; means over pictures.

    Attributes:
        l1: mean absolute difference, 0..1, best 0.
        psnr_db: peak signal-to-noise ratio in decibels, 0 and up, more is better; infinite for a perfect
            copy.
        coverage: share of all pixels inside the mask, 0..1.
        n_empty: pictures with an empty mask, left out of the means.
        l1_each, psnr_db_each: (N,) per picture, NaN where the mask is empty.
        ssim: structural similarity, -1..1, best 1; mean over the pictures with a window of 11 x 11 pixels
            inside the mask, NaN where there is none (or the pictures are smaller than that).
        ssim_each: (N,) per picture, NaN where there is no such window.
    """

    l1: float
    psnr_db: float
    coverage: float
    n_empty: int
    l1_each: np.ndarray
    psnr_db_each: np.ndarray
    ssim: float
    ssim_each: np.ndarray


@dataclass(frozen=True)
class ReconstructionResult:
    """A model's reconstructions beside the mean picture, in the same masks."""

    model: ReconstructionScores
    mean_picture: ReconstructionScores


def reconstruction_scores(
    prediction: Float[Tensor, "n 3 h w"],
    target: Float[Tensor, "n 3 h w"],
    mask: Float[Tensor, "n h w"],
) -> ReconstructionScores:
    """Masked L1, PSNR and SSIM of pictures in 0..1, averaged over pixels, channels, then pictures."""
    weight = mask[:, None].double().expand_as(target)
    total = weight.sum(dim=(1, 2, 3))
    difference = torch.where(weight > 0, prediction.double() - target.double(), 0.0)
    l1 = (weight * difference.abs()).sum(dim=(1, 2, 3)) / total
    psnr = -10 * ((weight * difference.square()).sum(dim=(1, 2, 3)) / total).log10()
    empty = total == 0
    if bool(empty.all()):
        raise ValueError("every mask is empty: the model renders nothing into the picture")
    ssim = torch.full_like(l1, torch.nan)
    if min(target.shape[-2:]) >= WINDOW:
        ssim = masked_ssim(prediction, target, mask)
    return ReconstructionScores(
        l1=l1[~empty].mean().item(),
        psnr_db=psnr[~empty].mean().item(),
        coverage=mask.double().mean().item(),
        n_empty=int(empty.sum()),
        l1_each=l1.numpy(force=True),
        psnr_db_each=psnr.numpy(force=True),
        ssim=ssim.nanmean().item(),
        ssim_each=ssim.numpy(force=True),
    )


def mean_picture(images: np.ndarray) -> Float[Tensor, "3 h w"]:
    """The mean of uint8 pictures (N, 3, H, W), in 0..1; reads a memory map a part at a time."""
    if len(images) == 0:
        raise ValueError("no pictures to average")
    total = np.zeros(images.shape[1:])
    for start in range(0, len(images), 1024):
        total += images[start : start + 1024].sum(axis=0, dtype=np.float64)
    return torch.from_numpy((total / len(images) / 255).astype(np.float32))


def evaluate_reconstruction(
    model: Any,
    images: np.ndarray,
    *,
    mean: Float[Tensor, "3 h w"] | None = None,
    batch_size: int = 64,
    progress: Progress | None = None,
) -> ReconstructionResult:
    """Score a model on uint8 pictures (N, 3, H, W) it has not seen.

    Args:
        model: with ``reconstruct`` and ``device``.
        images: pictures at the model's image size.
        mean: the control, best made of the training pictures; by default the mean of ``images`` themselves,
            which is a little harder to beat.
        batch_size: pictures at a time; changes speed and memory only.
        progress: called with (pictures done, pictures in all) after every batch.
    """
    mean = mean_picture(images) if mean is None else mean

    def render(batch: Tensor) -> tuple[Tensor, ...]:
        rendering = model.reconstruct(batch)
        return rendering.image.float().cpu(), batch.cpu(), rendering.mask.float().cpu()

    parts = map_batches(render, model, images, batch_size=batch_size, progress=progress)
    image, target, mask = (torch.cat(values) for values in zip(*parts, strict=True))
    return ReconstructionResult(
        reconstruction_scores(image, target, mask),
        reconstruction_scores(mean.expand_as(target), target, mask),
    )
