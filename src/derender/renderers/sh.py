"""`sh`: light from all sides as second-order spherical harmonics, in place of one lamp.

The factor ``light`` fills ``Scene.extra["environment"]``; ``scene.light`` is its main light. A scene that is
given another ``light`` is lit by that, as nearly as the harmonics can. LOOCC gives an image the light of
another. Source: Ramamoorthi and Hanrahan, SIGGRAPH 2001. Leaves out cast shadows.
"""

from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from derender.networks.factors import FACTORS, vector_net
from derender.renderers.renderer import Renderer
from derender.scene import Scene, environment
from derender.scene.perturb import exchange
from derender.scene.ranges import SceneRanges


def sh(colour: bool = False) -> Renderer:
    """Albedo times irradiance; ``colour``: nine coefficients of each channel instead of nine grey ones."""
    channels = 3 if colour else 1
    light = next(row for row in FACTORS if row.name == "light")
    row = replace(
        light, parameter="environment", build=vector_net(9 * channels), to_parameter=_from_raw,
        perturb=exchange,
    )  # fmt: skip
    maps = {"a ball in this light": partial(_ball, channels)}
    return Renderer("sh", (row,), irradiance=partial(_lit, channels), maps=maps)


def _from_raw(raw: Float[Tensor, "n k"], ranges: SceneRanges) -> Float[Tensor, "n k"]:
    mean = [ranges.ambient[end] + ranges.diffuse[end] / 4 for end in (0, 1)]
    return environment.bounded(raw.float(), (mean[0], mean[1]))


def _lit(channels: int, scene: Scene, normal: Tensor) -> Tensor:
    light = scene.extra.get("environment")
    light = environment.from_light(scene.light, channels) if light is None else light
    return environment.irradiance(light, normal)


def _ball(channels: int, scene: Scene, fov_deg: float) -> Tensor:
    """A white ball in the light, as large as the image."""
    lines = (torch.linspace(-1, 1, size, device=scene.depth.device) for size in scene.depth.shape[1:])
    y, x = torch.meshgrid(*lines, indexing="ij")
    inside = 1 - x * x - y * y
    normal = torch.stack([-x, -y, inside.clamp(min=0).sqrt()], dim=-1)
    return (_lit(channels, scene, normal.expand(len(scene), -1, -1, -1)) * (inside > 0)).expand(-1, 3, -1, -1)
