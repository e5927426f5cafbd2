"""Physical augmentation: change one factor of a scene by a random, physically possible amount.

Source: the paper, section 4 (LOOCC), uniform additive perturbations. Light: ambient and diffuse +-0.5, pitch
and yaw +-45 degrees. Camera: pitch +-22.5, yaw +-45 degrees. Here they are uniform over those values that
keep the result in its bounds, so that nothing piles up there. Geometry and albedo are exchanged between
images. Which factor changes, and how, is declared in its row (networks/factors.py).
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int64, Shaped
from pydantic import Field
from torch import Generator, Tensor

from derender.scene.camera import constant, shared_tensor
from derender.scene.ranges import SceneRanges
from derender.settings import Settings


class PerturbSettings(Settings):
    """Largest change of each perturbed number; the bounds of the result are those of `SceneRanges`."""

    ambient: float = Field(default=0.5, ge=0)  # largest change of ambient light
    diffuse: float = Field(default=0.5, ge=0)  # largest change of directional light
    light_deg: float = Field(default=45.0, ge=0)  # pitch and yaw of the light
    camera_pitch_deg: float = Field(default=22.5, ge=0)  # rotation about x
    camera_yaw_deg: float = Field(default=45.0, ge=0)  # rotation about y


MANY_ORDERS = 64  # drawn at once; a third of all leaves nothing in its place: none does once in 10^12 draws
DEFAULT_CHANGES = PerturbSettings()
DEFAULT_RANGES = SceneRanges()


def perturb_light(
    light: Float[Tensor, "n 4"], generator: Generator, settings: PerturbSettings = DEFAULT_CHANGES,
    ranges: SceneRanges = DEFAULT_RANGES,
) -> Float[Tensor, "n 4"]:  # fmt: skip
    """New ambient, diffuse, pitch and yaw for every row, each drawn by itself about the old one."""
    angle, bound = math.radians(settings.light_deg), math.radians(ranges.light_deg)
    changes = (settings.ambient, settings.diffuse, angle, angle)
    bounds = (ranges.ambient, ranges.diffuse, (-bound, bound), (-bound, bound))
    return _uniform_about(light, changes, bounds, generator)


def perturb_camera(
    camera: Float[Tensor, "n 6"], generator: Generator, settings: PerturbSettings = DEFAULT_CHANGES,
    ranges: SceneRanges = DEFAULT_RANGES,
) -> Float[Tensor, "n 6"]:  # fmt: skip
    """New pitch (rotation about x) and yaw (about y) for every row; roll and translation stay as they are."""
    changes = (math.radians(settings.camera_pitch_deg), math.radians(settings.camera_yaw_deg))
    bound = math.radians(ranges.rotation_deg)
    turned = _uniform_about(camera[:, :2], changes, ((-bound, bound), (-bound, bound)), generator)
    return torch.cat([turned, camera[:, 2:]], dim=1)


def exchange(value: Shaped[Tensor, "n ..."], generator: Generator, *_: object) -> Shaped[Tensor, "n ..."]:
    """Give every row another row's value, for factors without a range."""
    return value[derangement(len(value), generator).to(value.device)]


def derangement(n: int, generator: Generator) -> Int64[Tensor, " n"]:
    """A permutation of 0..n-1 that leaves nothing in its place, uniform over all of those."""
    if n < 2:
        raise ValueError(f"exchanging between images needs at least 2 of them, got {n}; raise the batch size")
    places = torch.arange(n, device=generator.device)
    if generator.device.type != "cpu":  # several at once: nothing is read back from a device
        keys = torch.rand(MANY_ORDERS, n, generator=generator, device=generator.device)
        orders = keys.argsort(dim=1)
        return orders.index_select(0, (orders != places).all(dim=1).int().argmax(dim=0, keepdim=True))[0]
    while True:
        order = torch.randperm(n, generator=generator, device=generator.device)
        if bool((order != places).all()):
            return order


def choose_factors(n: int, candidates: Sequence[int], generator: Generator) -> Int64[Tensor, " n"]:
    """For each of n images, which factor to perturb: uniform over the candidates, each image by itself."""
    if not candidates:
        raise ValueError("no factor to choose from; name at least one that may be perturbed")
    drawn = torch.randint(len(candidates), (n,), generator=generator, device=generator.device)
    return shared_tensor(tuple(candidates), generator.device, torch.int64)[drawn]


def _uniform_about(
    value: Float[Tensor, "n k"], changes: Sequence[float], bounds: Sequence[tuple[float, float]],
    generator: Generator,
) -> Float[Tensor, "n k"]:  # fmt: skip
    """Uniform within the bounds and each value's change; a value outside is first brought to the bound."""
    low, high = constant(tuple(bounds), value).unbind(dim=1)
    half_width = constant(tuple(changes), value)
    inside = torch.minimum(torch.maximum(value, low), high)
    start = torch.maximum(inside - half_width, low)
    end = torch.minimum(inside + half_width, high)
    drawn = torch.rand(value.shape, generator=generator, device=generator.device).to(value)
    return torch.lerp(start, end, drawn)
