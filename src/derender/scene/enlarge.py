"""The same scenes on a finer grid: smooth depth, sharp albedo, light and camera as they are.

Depth becomes a uniform cubic B-spline of the depth map: its slope at the old pixels is that of
``normals_from_depth``. Albedo is interpolated by the Catmull-Rom spline, which keeps every pixel's value.
Source: de Boor, A Practical Guide to Splines; Catmull and Rom, 1974. Leaves out maps of further factors.
"""

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from derender.scene.scene import Scene

SMALLEST_MAP = 4


def at_size(scene: Scene, size: int) -> Scene:
    """Scenes with depth and albedo of ``size`` x ``size``, no smaller than they are, with gradient."""
    height, width = scene.depth.shape[-2:]
    if height != width:
        raise ValueError(f"only square scenes can be enlarged, got {height}x{width}: cut or pad them first")
    if size < width or width < SMALLEST_MAP:
        least = max(width, SMALLEST_MAP)
        raise ValueError(f"a scene of {width}x{width} cannot be shown at {size}x{size}: give {least} or more")
    if size == width:
        return scene
    places = torch.linspace(0, width - 1, size, dtype=torch.float64)
    smooth, sharp = (cubic_weights(places, width, kind).to(scene.depth) for kind in ("smooth", "sharp"))
    albedo = (sharp @ scene.albedo @ sharp.T).clamp(0, 1)
    return scene.with_parameters(depth=smooth @ scene.depth @ smooth.T, albedo=albedo)


def doubled(maps: Float[Tensor, "n c h w"], kind: Literal["smooth", "sharp"]) -> Float[Tensor, "n c h2 w2"]:
    """Square maps at twice their size along such splines; 2x2 pixels lie where one was."""
    weights = cubic_weights(torch.arange(2 * maps.shape[-1]) / 2 - 0.25, maps.shape[-1], kind).to(maps)
    return weights @ maps @ weights.T


def cubic_weights(
    places: Float[Tensor, " size"], count: int, kind: Literal["smooth", "sharp"]
) -> Float[Tensor, "size count"]:
    """What places between the first (0) and the last (count - 1) of some values take of each value; float64.

    ``smooth`` is the uniform cubic B-spline, ``sharp`` the Catmull-Rom spline, which meets every value. Rows
    sum to 1 and straight lines stay straight; beyond its ends the row of values continues straight.
    """
    place = places.double()
    left = place.floor().clamp(0, count - 2).long()
    t = place - left
    if kind == "smooth":
        blend = ((1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3)
    else:
        blend = (-(t**3) + 2 * t**2 - t, 3 * t**3 - 5 * t**2 + 2, -3 * t**3 + 4 * t**2 + t, t**3 - t**2)
    total = 6 if kind == "smooth" else 2
    padded = place.new_zeros(len(place), count + 2)  # one value more at each end
    for offset, weight in enumerate(blend):
        padded[torch.arange(len(place)), left + offset] += weight / total
    weights = padded[:, 1:-1].clone()
    weights[:, :2] += padded[:, :1] * place.new_tensor([2.0, -1.0])
    weights[:, -2:] += padded[:, -1:] * place.new_tensor([-1.0, 2.0])
    return weights
