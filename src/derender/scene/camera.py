"""Pinhole camera and rigid motion: pixels to rays, depth to points, canonical frame to camera frame and back.

Frames: camera at the origin looking along +z, x right, y down. The canonical frame has the same axes; the
object rotates about its centre c = (0, 0, 1). Pixel centres lie at integers, pixels are square, the principal
point is ((W-1)/2, (H-1)/2). A camera is (rx, ry, rz, tx, ty, tz), radians and scene units. Leaves out lens
distortion and any focal length that varies over the batch.
"""

import math
from functools import lru_cache
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

OBJECT_CENTRE = (0.0, 0.0, 1.0)


def rotation_matrix(rotation_rad: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """R = Rz Ry Rx: rotate about x first (pitch > 0: top towards the camera), then y, then z."""
    (cx, cy, cz), (sx, sy, sz) = rotation_rad.cos().unbind(-1), rotation_rad.sin().unbind(-1)
    rows = (
        *(cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx),
        *(sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx),
        *(-sy, cy * sx, cy * cx),
    )
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def focal_px(width: int, fov_deg: float) -> float:
    """Focal length in pixels of a camera whose outermost pixel centres span ``fov_deg`` horizontally."""
    if not 0.0 < fov_deg < 180.0:
        raise ValueError(f"fov_deg must lie between 0 and 180 degrees, got {fov_deg}; synface64 uses 10")
    return (width - 1) / 2 / math.tan(math.radians(fov_deg) / 2)


def pixel_rays(
    height: int, width: int, fov_deg: float, device: torch.device | str | None = None,
    dtype: torch.dtype = torch.float32,
) -> Float[Tensor, "h w 3"]:  # fmt: skip
    """The point with z = 1 that each pixel centre sees."""
    focal = focal_px(width, fov_deg)
    x = (torch.arange(width, device=device, dtype=dtype) - (width - 1) / 2) / focal
    y = (torch.arange(height, device=device, dtype=dtype) - (height - 1) / 2) / focal
    x, y = x.expand(height, width), y[:, None].expand(height, width)
    return torch.stack((x, y, torch.ones_like(x)), dim=-1)


def unproject(depth: Float[Tensor, "n h w"], fov_deg: float) -> Float[Tensor, "n h w 3"]:
    """The surface point at each pixel of a depth map (depth is z, not the length of the ray)."""
    height, width = depth.shape[-2:]
    return depth[..., None] * pixel_rays(height, width, fov_deg, depth.device, depth.dtype)


def project(
    points: Float[Tensor, "*batch 3"], height: int, width: int, fov_deg: float
) -> Float[Tensor, "*batch 2"]:
    """Pixel coordinates (u right, v down) of points in front of the camera."""
    focal = focal_px(width, fov_deg)
    u = points[..., 0] / points[..., 2] * focal + (width - 1) / 2
    v = points[..., 1] / points[..., 2] * focal + (height - 1) / 2
    return torch.stack((u, v), dim=-1)


def motion(camera: Float[Tensor, "n 6"]) -> tuple[Float[Tensor, "n 3 3"], Float[Tensor, "n 3"]]:
    """Rotation R and offset o of canonical points: P_cam = R P + o."""
    rotation, (x, y, z) = rotation_matrix(camera[:, :3]), OBJECT_CENTRE
    rotated_centre = rotation[..., 0] * x + rotation[..., 1] * y + rotation[..., 2] * z
    moved_centre = torch.stack((camera[:, 3] + x, camera[:, 4] + y, camera[:, 5] + z), dim=-1)
    return rotation, moved_centre - rotated_centre


def to_camera(points: Float[Tensor, "n *grid 3"], camera: Float[Tensor, "n 6"]) -> Float[Tensor, "n *grid 3"]:
    """Canonical frame to camera frame: P_cam = R (P - c) + c + t."""
    rotation, offset = motion(camera)
    moved = torch.baddbmm(offset[:, None], points.flatten(1, -2), rotation.transpose(1, 2))
    return moved.view(points.shape)


def to_canonical(
    points: Float[Tensor, "n *grid 3"], camera: Float[Tensor, "n 6"]
) -> Float[Tensor, "n *grid 3"]:
    """Camera frame to canonical frame, the inverse of ``to_camera``."""
    rotation, centre = rotation_matrix(camera[:, :3]), constant(OBJECT_CENTRE, points)
    offset = centre - ((centre + camera[:, 3:])[:, None] @ rotation)[:, 0]
    return torch.baddbmm(offset[:, None], points.flatten(1, -2), rotation).view(points.shape)


def constant(values: Any, like: Tensor) -> Tensor:
    """Numbers in nested tuples as a tensor like another's dtype and device, made once; never change it."""
    return shared_tensor(values, like.device, like.dtype)


@lru_cache(maxsize=256)
def shared_tensor(values: Any, device: torch.device, dtype: torch.dtype) -> Tensor:
    """The tensor of these numbers that every caller shares: making it anew would wait for the device."""
    with torch.inference_mode(False):  # else it could serve no gradient later
        return torch.tensor(values, device=device, dtype=dtype)
