"""One ambient plus one directional light: its direction, and Lambertian shading.

A light is (ambient, diffuse, pitch, yaw), angles in radians. The direction is the one in which light travels,
(tan yaw, tan pitch, 1) normalised: yaw > 0 lights the left of the image, pitch > 0 lights from above. Leaves
out cast shadows, specular reflection and gamma.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize


def light_direction(light: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3"]:
    """Unit direction in which the light travels, along (tan yaw, tan pitch, 1); continuous at 90 degrees."""
    sin_pitch, sin_yaw = light[:, 2:].sin().unbind(-1)
    cos_pitch, cos_yaw = light[:, 2:].cos().unbind(-1)
    direction = (sin_yaw * cos_pitch, sin_pitch * cos_yaw, cos_yaw * cos_pitch)
    return normalize(torch.stack(direction, dim=-1), dim=-1)


def lambert_shading(
    normal: Float[Tensor, "n h w 3"], light: Float[Tensor, "n 4"]
) -> Float[Tensor, "n 1 h w"]:
    """Ambient + diffuse * max(0, n.l), not clipped at 1; inward unit normals in the frame of the light."""
    x, y, z = light_direction(light)[:, :, None, None].unbind(1)
    cosine = normal[..., 0] * x + normal[..., 1] * y + normal[..., 2] * z
    ambient, diffuse = light[:, 0, None, None], light[:, 1, None, None]
    return (ambient + diffuse * cosine.relu())[:, None]
