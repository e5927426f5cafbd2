"""Warping in plain torch: the definition, on any device. Where the surface lands is computed in float64."""

import torch
from torch import Tensor

from derender.render.rasterize import rasterize
from derender.render.sample import sample
from derender.scene.camera import focal_px, unproject


def warp(
    image: Tensor, depth: Tensor, rotation: Tensor, offset: Tensor, fov_deg: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Picture (N, C, H, W), depth and mask (N, H, W) of a surface moved by rotation and offset (float64)."""
    points = unproject(depth.double(), fov_deg)
    moved = torch.baddbmm(offset[:, None], points.flatten(1, 2), rotation.transpose(1, 2))
    seen = rasterize(moved.view(points.shape), focal_px(depth.shape[2], fov_deg), "reference")
    uv, mask = seen.uv.to(image.dtype), seen.mask.to(image.dtype)
    return sample(image, uv, mask, "reference"), seen.depth.to(image.dtype), mask
