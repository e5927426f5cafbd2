"""How well a rendering explains the image: photometric, plain L1 and depth smoothness losses.

Source: unsup3d (Wu et al., CVPR 2020), Eq. 3, and its public training code for what the paper leaves out: the
average runs over every pixel of the batch that the mask keeps.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

SIGMA_FLOOR = 1e-3

Mask = Float[Tensor, "n h w"] | Bool[Tensor, "n h w"]


def photometric_loss(
    prediction: Float[Tensor, "n c h w"], target: Float[Tensor, "n c h w"], mask: Mask,
    sigma: Float[Tensor, "n 1 h w"] | None,
) -> Float[Tensor, ""]:  # fmt: skip
    """Negative log-likelihood of a Laplace distribution around the prediction, averaged over the mask.

    ``sqrt(2) |dI| / sigma + log sigma`` with |dI| averaged over the channels. The best sigma is sqrt(2) |dI|,
    the least value log(1e-3) = -6.9. Without sigma it is the plain masked L1.
    """
    kept = (mask > 0).unsqueeze(1)
    difference = at_least_float32(prediction) - at_least_float32(target)
    error = torch.where(kept, difference, 0.0).abs().mean(dim=1)
    if sigma is None:
        return masked_mean(error, mask)
    scale = bounded_sigma(torch.where(kept, sigma, 1.0))[:, 0]
    return masked_mean(math.sqrt(2) * error / scale + scale.log(), mask)


def masked_l1(
    prediction: Float[Tensor, "n c h w"], target: Float[Tensor, "n c h w"], mask: Mask
) -> Float[Tensor, ""]:
    """Mean absolute difference over channels and over the pixels that the mask keeps; 0 is best."""
    return photometric_loss(prediction, target, mask, None)


def depth_smoothness(
    depth: Float[Tensor, "n h w"], depth_range: float = 0.2, border: int = 0, order: int = 1
) -> Float[Tensor, ""]:
    """Mean |step| to the next row plus mean |step| to the next column, in depth ranges; 0 is flat.

    Source: unsup3d's code. ``border`` columns at each side, which the presets clamp, are left out. Of
    ``order`` 2 (curvature, no published source) steps are second differences: 0 for every plane. That
    removes depth noise, which turns normals by tens of degrees, and stripes.
    """
    if depth_range <= 0:
        raise ValueError(f"depth_range must be above 0, got {depth_range}; give farthest minus nearest depth")
    depth = at_least_float32(depth[:, :, border : depth.shape[2] - border])
    if min(depth.shape[1:]) <= order:
        what, size = "smoothness" if order == 1 else "curvature", f"{order + 1} rows and {order + 1} columns"
        raise ValueError(f"depth {what} needs {size} inside the border, got {tuple(depth.shape)}")
    rows, columns = (depth.diff(n=order, dim=axis).abs().mean() for axis in (1, 2))
    return (rows + columns) / depth_range


def relief(depth: Float[Tensor, "n h w"], depth_range: float = 0.2, border: int = 0) -> Float[Tensor, "n 2"]:
    """How far each map's middle lies before its rim, along columns and along rows, in half depth ranges.

    Those are the heights of the parabolas that fit best; negative where the surface is hollow. ``border``
    columns at each side are left out. No published source.
    """
    depth, heights = at_least_float32(depth[:, :, border : depth.shape[2] - border]), []
    for across in (2, 1):
        profile = depth.mean(dim=across)
        bend = torch.linspace(-1, 1, profile.shape[1], device=depth.device, dtype=depth.dtype).square()
        bend = bend - bend.mean()
        heights.append(profile @ bend / bend.square().sum())
    return torch.stack(heights, dim=1) * 2 / depth_range


def masked_mean(value: Float[Tensor, "n h w"], weight: Mask) -> Float[Tensor, ""]:
    """Weighted mean over the whole batch; exactly 0, with zero gradient, where every weight is 0."""
    weight = weight.to(value.dtype)
    total = weight.sum()
    return torch.where(weight > 0, value * weight, 0.0).sum() / torch.where(total > 0, total, 1.0)


def bounded_sigma(sigma: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Never below the floor, where a softplus could reach 0, and with a gradient."""
    return (at_least_float32(sigma).square() + SIGMA_FLOOR**2).sqrt()


def at_least_float32(value: Tensor) -> Tensor:
    """Half precision becomes float32; float32 and float64 stay as they are."""
    return value.float() if value.dtype in (torch.bfloat16, torch.float16) else value
