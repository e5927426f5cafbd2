"""The perceptual loss, and the one place that makes the features it compares.

Source: unsup3d (Wu et al., CVPR 2020), Eq. 7: a Gaussian of the feature difference, with a confidence per
feature location.
"""

from collections.abc import Callable
from pathlib import Path

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn import functional

from derender.objectives.perceptual_features import CALIBRATION_IMAGES, PerceptualFeatures, load_vgg16
from derender.objectives.reconstruction import at_least_float32, bounded_sigma, masked_mean
from derender.objectives.self_features import train_self_features

PERCEPTUAL_KINDS = ("vgg16", "self", "none")


def perceptual_loss(
    prediction: Float[Tensor, "n c fh fw"],
    target: Float[Tensor, "n c fh fw"],
    mask: Float[Tensor, "n h w"] | Bool[Tensor, "n h w"],
    sigma: Float[Tensor, "n 1 sh sw"] | None,
) -> Float[Tensor, ""]:
    """``|df|^2 / (2 sigma^2) + log sigma`` with |df|^2 averaged over channels, weighted by the mask's share.

    The mask is average-pooled to the features' resolution. Without sigma it is the plain mean of |df|^2 (not
    half of it), as in unsup3d's code; 0 is best there. Best sigma is |df|.
    """
    height, width = size = prediction.shape[-2], prediction.shape[-1]
    pooled = functional.adaptive_avg_pool2d(mask if mask.is_floating_point() else mask.float(), size)
    weight = at_least_float32(pooled)
    kept = (weight > 0).unsqueeze(1)
    difference = at_least_float32(prediction) - at_least_float32(target)
    squared = torch.where(kept, difference, 0.0).square().mean(dim=1)
    if sigma is None:
        return masked_mean(squared, weight)
    if sigma.shape[-2:] != size:
        raise ValueError(
            f"the perceptual sigma must have the features' resolution {height} x {width}, got shape "
            f"{tuple(sigma.shape)}; let the confidence net put out that size"
        )
    deviation = bounded_sigma(torch.where(kept, sigma, 1.0))[:, 0]
    return masked_mean(squared / (2 * deviation.square()) + deviation.log(), weight)


def build_perceptual(
    kind: str,
    images: UInt8[Tensor, "n 3 h w"] | None = None,
    *,
    weights: Path | str | None = None,
    seed: int = 0,
    steps: int | None = None,
    progress: Callable[[int, int, float], None] | None = None,
    device: torch.device | str = "cpu",
) -> PerceptualFeatures | None:
    """Frozen, calibrated features of one of ``PERCEPTUAL_KINDS``; None for ``none``.

    ``images`` are training images: ``self`` learns from them, and both kinds are calibrated on 256 of them.
    Without images ``vgg16`` keeps scale 1. ``weights`` is VGG16's file; None looks in torch hub's cache.
    """
    if kind == "none":
        return None
    if kind == "vgg16":
        features = load_vgg16(weights).to(device)
        if images is not None:
            features.calibrate_(images[:CALIBRATION_IMAGES].to(device).float() / 255)
        return features
    if images is None:
        raise ValueError("perceptual features 'self' are learned from the training images: give images")
    return train_self_features(images, seed=seed, steps=steps, progress=progress, device=device)
