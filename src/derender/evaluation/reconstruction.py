"""How well a model renders pictures it has not seen, beside pictures that nobody rendered.

Controls are the mean picture; the pictures from 64 principal components of their pixels, which know no
geometry; and an untrained model. The first two are scored inside the model's own masks.
A low error alone proves nothing about geometry (a copied picture has none): read it with
evaluation/geometry.py. SSIM is in evaluation/structural_similarity.py. Leaves out learned similarities.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from derender.evaluation.bootstrap import RESAMPLES, ScoredRow
from derender.evaluation.picture_scores import picture_rows
from derender.evaluation.structural_similarity import WINDOW, masked_ssim
from derender.features import Progress, map_batches

COMPONENTS = 64


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
    """A model's reconstructions beside its controls.

    Attributes:
        model: of the renderings.
        mean_picture: of the mean picture in the same masks.
        components: of the pictures from principal components in the same masks; None where not asked for.
        untrained: of the same architecture with fresh weights, in its own masks; None where none was given.
    """

    model: ReconstructionScores
    mean_picture: ReconstructionScores
    components: ReconstructionScores | None = None
    untrained: ReconstructionScores | None = None


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
    components_of: np.ndarray | None = None,
    untrained: Any = None,
    batch_size: int = 64,
    progress: Progress | None = None,
) -> ReconstructionResult:
    """Score a model on uint8 pictures (N, 3, H, W) it has not seen.

    Args:
        model: with ``reconstruct`` and ``device``.
        images: pictures at the model's image size.
        mean: the control, best made of the training pictures; by default the mean of ``images`` themselves,
            which is a little harder to beat.
        components_of: pictures that give 64 principal components (fewer where they are fewer than 256), for
            that control.
        untrained: the same architecture with fresh weights, for that control.
        batch_size: pictures at a time; changes speed and memory only.
        progress: called with (pictures done, pictures in all) after every batch.
    """
    mean = mean_picture(images) if mean is None else mean

    def rendered(any_model: Any, report: Progress | None) -> tuple[Tensor, Tensor, Tensor]:
        def render(batch: Tensor) -> tuple[Tensor, ...]:
            rendering = any_model.reconstruct(batch)
            return rendering.image.float().cpu(), batch.cpu(), rendering.mask.float().cpu()

        parts = map_batches(render, any_model, images, batch_size=batch_size, progress=report)
        image, target, mask = (torch.cat(values) for values in zip(*parts, strict=True))
        return image, target, mask

    image, target, mask = rendered(model, progress)
    known = None
    if components_of is not None:
        known = reconstruction_scores(from_components(images, components_of), target, mask)
    return ReconstructionResult(
        reconstruction_scores(image, target, mask),
        reconstruction_scores(mean.expand_as(target), target, mask),
        known,
        None if untrained is None else reconstruction_scores(*rendered(untrained, None)),
    )


def component_count(pictures: int) -> int:
    """How many components so many pictures give: 64, and at most a quarter of their number."""
    return max(1, min(COMPONENTS, pictures // 4))


def from_components(images: np.ndarray, fitted: np.ndarray) -> Float[Tensor, "n 3 h w"]:
    """uint8 pictures (N, 3, H, W) from their principal components alone, in 0..1.

    Args:
        images: to show.
        fitted: (M, 3, H, W) uint8 that give the components.
    """
    from sklearn.decomposition import PCA

    pca = PCA(component_count(len(fitted)), random_state=0).fit(_flat(fitted))
    again = pca.inverse_transform(pca.transform(_flat(images)))
    return torch.from_numpy(again.astype(np.float32)).clamp(0, 1).reshape(images.shape)


def reconstruction_rows(
    result: ReconstructionResult, fitted: int, resample_count: int = RESAMPLES
) -> tuple[ScoredRow, ...]:
    """The model beside its controls, L1, PSNR and SSIM with intervals; ``fitted`` gave the components."""
    named = {"model": result.model, "mean picture": result.mean_picture}
    if result.components is not None:
        named[f"PCA ({component_count(fitted)})"] = result.components
    if result.untrained is not None:
        named["untrained model"] = result.untrained
    scores = {
        name: {"l1": one.l1_each, "psnr_db": one.psnr_db_each, "ssim": one.ssim_each}
        for name, one in named.items()
    }
    return picture_rows(scores, list(named)[1:], lower=("l1",), resample_count=resample_count)


def _flat(images: np.ndarray) -> np.ndarray:
    return np.asarray(images, np.float32).reshape(len(images), -1) / 255
