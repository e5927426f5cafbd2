"""Shade the canonical view: albedo times Lambertian shading of the depth map's normals.

``reference`` composes the scene's own functions, which define what is computed; ``numba`` and ``triton`` go
over the image once forward and twice backward and store no normals.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from derender.render.backends import chosen_backend
from derender.render.shading.operators import FORWARD
from derender.scene.camera import focal_px
from derender.scene.light import lambert_shading, light_direction
from derender.scene.normals import normals_from_depth


def shade(
    depth: Float[Tensor, "n h w"],
    albedo: Float[Tensor, "n c h w"],
    light: Float[Tensor, "n 4"],
    fov_deg: float,
    backend: str = "auto",
) -> Float[Tensor, "n c h w"]:
    """The canonical image, from 0 on and not clipped at 1."""
    chosen = chosen_backend(depth.device, backend)
    if chosen == "reference":
        return albedo * lambert_shading(normals_from_depth(depth, fov_deg), light)
    lamp = torch.cat((light[:, :2], light_direction(light)), dim=1)
    return FORWARD[chosen](depth, albedo, lamp, focal_px(depth.shape[2], fov_deg))
