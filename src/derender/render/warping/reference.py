"""Warping in plain torch: the definition, on any device. Where the surface lands is computed in float64.

``grid_sample`` is not used: normalising coordinates to -1..1 and back costs the identity camera its
exactness.
"""

import torch
from torch import Tensor

from derender.render.rasterize import rasterize
from derender.scene.camera import focal_px, unproject


def warp(
    image: Tensor, depth: Tensor, rotation: Tensor, offset: Tensor, fov_deg: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Image (N, C, H, W), depth and mask (N, H, W) of a surface moved by rotation and offset (float64)."""
    points = unproject(depth.double(), fov_deg)
    moved = torch.baddbmm(offset[:, None], points.flatten(1, 2), rotation.transpose(1, 2))
    seen = rasterize(moved.view(points.shape), focal_px(depth.shape[2], fov_deg), "reference")
    uv, mask = seen.uv.to(image.dtype), seen.mask.to(image.dtype)
    return sample(image, uv, mask), seen.depth.to(image.dtype), mask


def sample(image: Tensor, uv: Tensor, mask: Tensor) -> Tensor:
    """The image (N, C, H, W) at pixel coordinates (N, H2, W2, 2), bilinear; 0, no gradient where mask is 0.

    Beyond the border, which `rasterize` may exceed by its edge tolerance, the border cell is continued.
    """
    count, channels, height, width = image.shape
    uv = torch.where(mask[..., None] > 0, uv, 0)
    left = uv[..., 0].detach().floor().clamp(0, width - 2)
    top = uv[..., 1].detach().floor().clamp(0, height - 2)
    across, down = (uv[..., 0] - left)[:, None], (uv[..., 1] - top)[:, None]
    corner = (top * width + left).long().flatten(1)[:, None].expand(-1, channels, -1)

    def look_up(step: int) -> Tensor:
        return image.flatten(2).gather(2, corner + step).view(count, channels, *mask.shape[1:])

    upper = look_up(0) * (1 - across) + look_up(1) * across
    lower = look_up(width) * (1 - across) + look_up(width + 1) * across
    return torch.where(mask[:, None] > 0, upper * (1 - down) + lower * down, 0)
