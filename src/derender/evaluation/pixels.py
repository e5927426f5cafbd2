"""How well a model reconstructs images it has not seen: L1, PSNR and SSIM inside the mask, beside controls.

Controls are the mean image and the images from 64 principal components of their pixels, inside the model's
own masks, and an untrained model. A low error alone proves nothing about geometry (a copied image has none):
read it with evaluation/truth.py.

SSIM: Wang et al., IEEE TIP 2004, computed by scikit-image: a Gaussian window of 11 x 11 pixels with sigma
1.5, mean over colours. Windows that reach over the edge of the mask or the image are left out. Leaves out
several scales and learned similarities.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from skimage.metrics import structural_similarity
from torch import Tensor

from derender.baselines.controls import flat_pixels
from derender.evaluation.image_scores import ImageResult, means_and_each
from derender.evaluation.score_table import Column
from derender.features import Progress, map_batches

COMPONENTS, COMPONENT_IMAGES = 64, 2_000
WINDOW = 11
AS_PUBLISHED = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}  # windows of SSIM


@dataclass(frozen=True)
class ReconstructionScores:
    """Errors inside the mask; means over images, and (N,) values per image.

    ``l1`` is 0..1, best 0; ``psnr_db`` 0 and up, infinite for a copy. ``ssim`` is -1..1, best 1, over images
    with a window of 11 x 11 pixels inside the mask, NaN without. ``coverage`` is the share of all pixels
    inside the mask; images with an empty mask (``n_empty``) are left out.
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
class ReconstructionResult(ImageResult):
    """A model's reconstructions beside controls; None where not requested. Controls are the mean image and
    the images from ``n_components`` principal components in the same masks, and an untrained model in its
    own.
    """

    columns: ClassVar = {
        "l1": Column("L1", "low", 4, "mean absolute difference inside the mask, 0 to 1, best 0"),
        "psnr_db": Column("PSNR", "high", 2, "peak signal-to-noise ratio in decibels"),
        "ssim": Column("SSIM", "high", note="structural similarity inside the mask, at most 1"),
    }
    caption = "Reconstruction of {}"
    coverage = Column("coverage", None, note="share of all pixels inside the mask")
    notes: ClassVar = {"untrained model": "same networks, fresh weights, in its own mask"}

    model: ReconstructionScores
    mean_picture: ReconstructionScores
    components: ReconstructionScores | None = None
    untrained: ReconstructionScores | None = None
    n_components: int = 0


def reconstruction_scores(
    prediction: Float[Tensor, "n 3 h w"], target: Float[Tensor, "n 3 h w"], mask: Float[Tensor, "n h w"]
) -> ReconstructionScores:
    """Masked L1, PSNR and SSIM of images in 0..1, averaged over pixels, channels, then images."""
    weight = mask[:, None].double().expand_as(target)
    total = weight.sum(dim=(1, 2, 3))
    if not bool(total.any()):
        raise ValueError("every mask is empty: the model renders nothing into the image")
    difference = torch.where(weight > 0, prediction.double() - target.double(), 0.0)
    l1 = (weight * difference.abs()).sum(dim=(1, 2, 3)) / total
    psnr = -10 * ((weight * difference.square()).sum(dim=(1, 2, 3)) / total).log10()
    scores = means_and_each(l1=l1, psnr_db=psnr, ssim=masked_ssim(prediction, target, mask))
    coverage, n_empty = mask.double().mean().item(), int((total == 0).sum())
    return ReconstructionScores(coverage=coverage, n_empty=n_empty, **scores)


def mean_image(images: np.ndarray) -> Float[Tensor, "3 h w"]:
    """The mean of uint8 images (N, 3, H, W), in 0..1."""
    return torch.from_numpy((images.mean(axis=0, dtype=np.float64) / 255).astype(np.float32))


def evaluate_reconstruction(
    model: Any, images: np.ndarray, *, mean: Float[Tensor, "3 h w"] | None = None,
    components_of: np.ndarray | None = None, untrained: Any = None, batch_size: int = 64,
    progress: Progress | None = None,
) -> ReconstructionResult:  # fmt: skip
    """Score a model with ``reconstruct`` and ``device`` on uint8 images (N, 3, H, W) it has not seen.

    The mean image is best that of the training images, by default of ``images``. ``components_of`` are images
    that give 64 principal components (fewer where they are fewer than 256), for that control. The rest is as
    of ``evaluate_geometry``.
    """

    def rendered(net: Any, report: Progress | None = None) -> tuple[Tensor, ...]:
        def render(batch: Tensor) -> tuple[Tensor, ...]:
            rendering = net.reconstruct(batch)
            return rendering.image.float().cpu(), batch.cpu(), rendering.mask.float().cpu()

        parts = map_batches(render, net, images, batch_size=batch_size, progress=report)
        return tuple(map(torch.cat, zip(*parts, strict=True)))

    image, target, mask = rendered(model, progress)
    mean, fitted = mean_image(images) if mean is None else mean, components_of
    return ReconstructionResult(
        reconstruction_scores(image, target, mask),
        reconstruction_scores(mean.expand_as(target), target, mask),
        None if fitted is None else reconstruction_scores(from_components(images, fitted), target, mask),
        None if untrained is None else reconstruction_scores(*rendered(untrained)),
        0 if fitted is None else component_count(len(fitted)),
    )


def component_count(images: int) -> int:
    """Number of principal components from so many images: 64, at most a quarter of their number."""
    return max(1, min(COMPONENTS, images // 4))


def from_components(images: np.ndarray, fitted: np.ndarray) -> Float[Tensor, "n 3 h w"]:
    """uint8 images (N, 3, H, W) from the principal components of (M, 3, H, W) others alone, in 0..1."""
    from sklearn.decomposition import PCA

    with np.errstate(invalid="ignore"):  # a single image has no variance
        pca = PCA(component_count(len(fitted)), random_state=0).fit(flat_pixels(fitted))
    again = pca.inverse_transform(pca.transform(flat_pixels(images))).astype(np.float32)
    return torch.from_numpy(again).clamp(0, 1).reshape(images.shape)


def masked_ssim(
    prediction: Float[Tensor, "n 3 h w"], target: Float[Tensor, "n 3 h w"], mask: Float[Tensor, "n h w"]
) -> Float[Tensor, " n"]:
    """SSIM of images in 0..1 over the windows inside the mask, per image; -1..1, best 1.

    NaN where no window of 11 x 11 pixels lies inside the mask. Values outside the mask do not matter, and may
    be anything, NaN included.
    """
    if min(target.shape[-2:]) < WINDOW:
        return torch.full((len(target),), torch.nan, dtype=torch.float64)
    hole = torch.nn.functional.pad((~(mask > 0)).float(), (WINDOW // 2,) * 4, value=1.0)
    inside = torch.nn.functional.max_pool2d(hole[:, None], WINDOW, stride=1)[:, 0] == 0  # window centres
    results = []
    for shown, true, covered, centres in zip(prediction, target, mask > 0, inside, strict=True):
        pair = (torch.where(covered, values.double(), 0.0).cpu().numpy() for values in (shown, true))
        each = structural_similarity(*pair, data_range=1.0, channel_axis=0, full=True, **AS_PUBLISHED)[1]
        results.append(torch.from_numpy(each.mean(axis=0))[centres.cpu()].mean())
    return torch.stack(results)
