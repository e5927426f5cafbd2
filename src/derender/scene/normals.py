"""Surface normals of a depth map.

The cross product of the differences of the unprojected points along u and v (central inside, one-sided at the
border), worked out by hand. Exact on planes at every angle. Depth must be positive. Leaves out smoothing.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from derender.scene.camera import focal_px


def normals_from_depth(depth: Float[Tensor, "n h w"], fov_deg: float) -> Float[Tensor, "n h w 3"]:
    """Inward unit normals in the frame of the depth map: a plane that faces the camera has (0, 0, 1)."""
    height, width = depth.shape[-2:]
    if height < 2 or width < 2:
        raise ValueError(f"normals need a depth map of at least 2x2 pixels, got {height}x{width}")
    focal = focal_px(width, fov_deg)
    slope_u, slope_v = _relative_slope(depth, 2), _relative_slope(depth, 1)
    u = torch.arange(width, device=depth.device, dtype=depth.dtype) - (width - 1) / 2
    v = torch.arange(height, device=depth.device, dtype=depth.dtype) - (height - 1) / 2
    x, y, z = -focal * slope_u, -focal * slope_v, 1 + u * slope_u + v[:, None] * slope_v
    scale = (x * x + y * y + z * z).rsqrt()
    return torch.stack((x * scale, y * scale, z * scale), dim=-1)


def _relative_slope(depth: Tensor, axis: int) -> Tensor:
    """(next - previous) / (next + previous) along an axis; at the border (next - own) / next or its mirror.

    Points are P = d r, with rays r that change by a constant s per pixel. So P_next - P_previous = (next -
    previous) r + (next + previous) s, and the slope is the ratio of the two coefficients.
    """
    size = depth.shape[axis]
    previous, following = depth.narrow(axis, 0, size - 1), depth.narrow(axis, 1, size - 1)
    first = (following.narrow(axis, 0, 1) - previous.narrow(axis, 0, 1)) / following.narrow(axis, 0, 1)
    last = (following.narrow(axis, -1, 1) - previous.narrow(axis, -1, 1)) / previous.narrow(axis, -1, 1)
    before, after = depth.narrow(axis, 0, size - 2), depth.narrow(axis, 2, size - 2)
    return torch.cat((first, (after - before) / (after + before), last), axis)
