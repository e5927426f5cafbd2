"""Light from all sides: irradiance in spherical harmonics up to the second order, and its main direction.

An environment is (N, 9) coefficients, grey, or (N, 27), nine of each channel. They give the light that falls
on a surface by its inward normal: E(n) = max(0, sum of c_k Y_k(n)). Source: Ramamoorthi and Hanrahan,
SIGGRAPH 2001. Of light that is nowhere negative the orders' norms are bounded by that of order 0: ``LIMITS``.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from derender.scene.light import light_direction

MEAN = math.sqrt(1 / (4 * math.pi))  # Y_0: the mean irradiance is this times the first coefficient
LINEAR = math.sqrt(3 / (4 * math.pi))
LIMITS = (2 / math.sqrt(3), math.sqrt(5) / 4)  # norms of orders 1, 2 over order 0's, of one directional light
_LEAST_FORWARD = 0.05  # share of the main light that goes forwards: a scene's light is before its object


def harmonics(direction: Float[Tensor, "*grid 3"]) -> Float[Tensor, "*grid 9"]:
    """The nine real spherical harmonics of orders 0 to 2 at unit directions, orthonormal on the sphere."""
    x, y, z = direction.unbind(-1)
    second = math.sqrt(15 / (4 * math.pi))
    first = (torch.full_like(x, MEAN), LINEAR * y, LINEAR * z, LINEAR * x)
    polar, equal = second / math.sqrt(12) * (3 * z * z - 1), second / 2 * (x * x - y * y)
    return torch.stack((*first, second * x * y, second * y * z, polar, second * x * z, equal), dim=-1)


def irradiance(
    environment: Float[Tensor, "n k"], normal: Float[Tensor, "n h w 3"]
) -> Float[Tensor, "n c h w"]:
    """The light on surfaces, from 0 on; one channel or three."""
    coefficients = environment.view(len(environment), -1, 9)
    return (harmonics(normal)[:, None] * coefficients[:, :, None, None]).sum(dim=-1).relu()


def from_light(light: Float[Tensor, "n 4"], channels: int = 1) -> Float[Tensor, "n k"]:
    """The nearest environment to one ambient and one directional light, the same in every channel."""
    ambient, diffuse = light[:, :1], light[:, 1:2]
    basis = harmonics(light_direction(light))
    order = [math.pi] + [2 * math.pi / 3] * 3 + [math.pi / 4] * 5  # the cosine lobe's own coefficients
    coefficients = diffuse * basis * basis.new_tensor(order)
    coefficients = torch.cat([coefficients[:, :1] + ambient / MEAN, coefficients[:, 1:]], dim=1)
    return coefficients.repeat(1, channels)


def main_light(environment: Float[Tensor, "n k"]) -> Float[Tensor, "n 4"]:
    """The ambient and directional light whose order 0 and 1 are those of an environment."""
    grey = environment.view(len(environment), -1, 9).mean(dim=1)
    x, y, z = grey[:, 3], grey[:, 1], grey[:, 2]
    strength = torch.stack([x, y, z]).norm(dim=0)
    diffuse = strength / (2 * math.pi / 3 * LINEAR)
    ambient = (grey[:, 0] * MEAN - diffuse / 4).clamp(min=0)
    z = torch.maximum(z, _LEAST_FORWARD * strength.clamp(min=1e-6))
    return torch.stack([ambient, diffuse, torch.atan2(y, z), torch.atan2(x, z)], dim=1)


def bounded(raw: Float[Tensor, "n k"], mean: tuple[float, float]) -> Float[Tensor, "n k"]:
    """Environments from numbers in -1..1: mean irradiance in a range, the orders within ``LIMITS``.

    Zeros are light of which a quarter, if it can be, comes from the front.
    """
    shares = raw.view(len(raw), -1, 9)
    first = (mean[0] + (mean[1] - mean[0]) * (shares[..., :1] / 2 + 0.5)) / MEAN
    linear = shares[..., 1:4] + shares.new_tensor([0.0, 0.25, 0.0])
    orders = [part / part.norm(dim=-1, keepdim=True).clamp(min=1) for part in (linear, shares[..., 4:])]
    scaled = [limit * first * part for limit, part in zip(LIMITS, orders, strict=True)]
    return torch.cat([first, *scaled], dim=-1).flatten(1)
