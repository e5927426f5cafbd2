"""A renderer: the factors of a scene and how they make its image, in stages that combine.

    canonical = (albedo^g * (ambient + diffuse * visible * max(0, n.l)) + visible * specular)^(1/g)
    image     = atmosphere(canonical moved in front of the camera)

n.l is the cosine between surface and light, g the gamma of the images. A renderer sets some of the stages and
brings the factors they need; ``a + b`` has the stages of both. Without stages it is ``lambert``, drawn by the
fused kernels of ``derender.render``.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from derender.networks import FACTORS, Factor
from derender.render import Rendering, shade, unwarp, warp
from derender.render.shading import shade as lambert
from derender.scene import Scene
from derender.scene.normals import normals_from_depth

Maps = Float[Tensor, "n h w"]

STAGES = ("visibility", "irradiance", "specular", "atmosphere")
DARKEST = 1e-6  # under a root: its slope is infinite at 0


@dataclass(frozen=True)
class Renderer:
    """Scenes to images, by name.

    Attributes:
        name: as in ``config.json``; of a renderer of your own ``package.module:thing``.
        factors: rows beside the paper's four; one of the same name takes that row's place.
        visibility: (scene, fov_deg) to the share (N, H, W) of the directional light that arrives, 0..1.
        irradiance: (scene, normals) to the light (N, 1 or 3, H, W) on the surface, in place of Lambert's.
        specular: (scene, normals, fov_deg) to the light (N, 1 or 3, H, W) that is reflected like a mirror's.
        atmosphere: (rendering, scene) to the rendering through the air, in the camera's view.
        gamma: of the images; light is added in values to this power.
        maps: further columns of a panel, (scene, fov_deg) to (N, H, W) or (N, 3, H, W) in 0..1 by title.
        penalty: (scene, shading) to a scalar that training adds to its loss.
        function: (scene, fov_deg) to the rendering, in place of all stages; shading stays Lambert's.
    """

    name: str
    factors: tuple[Factor, ...] = ()
    visibility: Callable[[Scene, float], Tensor] | None = None
    irradiance: Callable[[Scene, Tensor], Tensor] | None = None
    specular: Callable[[Scene, Tensor, float], Tensor] | None = None
    atmosphere: Callable[[Rendering, Scene], Rendering] | None = None
    gamma: float = 1.0
    maps: Mapping[str, Callable[[Scene, float], Tensor]] = field(default_factory=dict)
    penalty: Callable[[Scene, Tensor], Tensor] | None = None
    function: Callable[[Scene, float], Rendering] | None = None

    @property
    def all_factors(self) -> tuple[Factor, ...]:
        """The paper's four rows, changed and extended by this renderer's."""
        return tuple({row.name: row for row in (*FACTORS, *self.factors)}.values())

    def __call__(self, scene: Scene, fov_deg: float, backend: str = "auto") -> Rendering:
        """Images of scenes; a number out of its range, or NaN made of finite scenes, is a ValueError."""
        if self.function is not None:
            return self.function(scene, fov_deg)
        self.check(scene)
        image = self.shade(scene, fov_deg, backend)
        rendering = warp(image, scene.depth, scene.camera, fov_deg, backend)
        if self.atmosphere is not None:
            rendering = self.atmosphere(rendering, scene)
        staged = any(getattr(self, stage) is not None for stage in STAGES)
        if staged and not _finite(rendering.image) and all(map(_finite, scene.parameters.values())):
            fix = "look for a division by 0, or a root or logarithm of negative values, in its stages"
            raise ValueError(f"the renderer {self.name!r} makes NaN or infinity of finite scenes: {fix}")
        return rendering

    def shade(self, scene: Scene, fov_deg: float, backend: str = "auto") -> Float[Tensor, "n 3 h w"]:
        """The canonical image, before any camera."""
        if not (self.irradiance or self.specular or self.visibility) and self.gamma == 1:
            return shade(scene.depth, scene.albedo, scene.light, fov_deg, backend)
        with torch.autocast(scene.depth.device.type, enabled=False):
            visible = None if self.visibility is None else self.visibility(scene, fov_deg)
            albedo = scene.albedo if self.gamma == 1 else scene.albedo.clamp(min=DARKEST) ** self.gamma
            image = albedo * self._light(scene, fov_deg, visible, backend)
            if self.specular is not None:
                shine = self.specular(scene, normals_from_depth(scene.depth, fov_deg), fov_deg)
                image = image + (shine if visible is None else shine * visible[:, None])
            return image if self.gamma == 1 else image.clamp(min=DARKEST) ** (1 / self.gamma)

    def shading(self, scene: Scene, fov_deg: float) -> Float[Tensor, "n c h w"]:
        """The diffuse light on the canonical surface, by which albedo is multiplied; one channel or three."""
        visible = None if self.visibility is None else self.visibility(scene, fov_deg)
        light = self._light(scene, fov_deg, visible)
        return light if self.gamma == 1 else light.clamp(min=DARKEST) ** (1 / self.gamma)

    def veil(self, scene: Scene, fov_deg: float) -> Float[Tensor, "n k h w"]:
        """Over the matt surface, on it: the share of light lost in air, and RGB added; else no channels."""
        if not (self.specular or self.atmosphere):
            return scene.depth[:, None][:, :0]
        shine = self.shade(scene, fov_deg) - scene.albedo * self.shading(scene, fov_deg)
        air = self.atmosphere or (lambda rendering, _: rendering)
        view = warp(0 * shine, scene.depth, scene.camera, fov_deg)
        black, white = (air(replace(view, image=view.image + one), scene).image for one in (0, 1))
        through = torch.cat([black, (white - black).mean(dim=1, keepdim=True)], dim=1)
        own, kept = unwarp(through, scene.depth, scene.camera, fov_deg).split((3, 1), dim=1)
        return torch.cat([1 - kept, shine * kept + own], dim=1)

    def _light(self, scene: Scene, fov_deg: float, visible: Tensor | None, backend: str = "auto") -> Tensor:
        if self.irradiance is not None:
            return self.irradiance(scene, normals_from_depth(scene.depth, fov_deg))
        white = torch.ones_like(scene.depth)[:, None]
        light = lambert(scene.depth, white, scene.light, fov_deg, backend)
        if visible is None:
            return light
        return torch.lerp(scene.light[:, 0, None, None, None].expand_as(light), light, visible[:, None])

    def check(self, scene: Scene) -> None:
        """A ValueError: the scene lacks a parameter, or a number is out of its range (on the CPU only)."""
        for row in self.factors:
            value = scene.parameters.get(row.parameter)
            if value is None and row.name in {one.name for one in FACTORS}:
                continue  # the scene was given the paper's own parameter
            if value is None:
                has = f"this scene has {', '.join(scene.parameters)}: it is of a model with another renderer"
                raise ValueError(f"the renderer {self.name!r} needs the scene's {row.parameter!r}, {has}")
            if not row.numbers or value.device.type != "cpu" or not len(value):  # elsewhere it would wait
                continue
            if value.ndim != 2 or value.shape[1] != len(row.numbers):
                names = ", ".join(number.name for number in row.numbers)
                raise ValueError(f"{row.name} must be (N, {len(row.numbers)}): {names}; got {value.shape}")
            ends = zip(row.numbers, value.amin(0).tolist(), value.amax(0).tolist(), strict=True)
            for number, least, most in ends:
                slack = 1e-4 * (number.high - number.low)
                if least < number.low - slack or most > number.high + slack:
                    what = f"{row.name} {number.name} must lie in {number.low:g}..{number.high:g}"
                    got = least if least < number.low else most
                    raise ValueError(f"{what} for the renderer {self.name!r}, got {got:g}")

    def __add__(self, other: "Renderer") -> "Renderer":
        """The stages and factors of both; where both set the same one, a ValueError."""
        name = f"{self.name}+{other.name}"
        if self == other:
            raise ValueError(f"the renderer {name!r} has {other.name!r} twice")
        own = {stage: getattr(other, stage) for stage in (*STAGES, "penalty") if getattr(other, stage)}
        taken = [stage for stage in own if getattr(self, stage) is not None]
        both = [row.name for row in other.factors if row.name in {mine.name for mine in self.factors}]
        pair = {self.irradiance is not None, other.irradiance is not None}
        direct = next((one for one in (self, other) if one.visibility or one.specular), None)
        if taken or both or (len(pair) == 2 and direct is not None):
            what = f"the {taken[0]}" if taken else f"the factor {both[0]!r}" if both else "the light"
            raise ValueError(f"{self.name!r} and {other.name!r} cannot be combined: each sets {what}")
        gamma = max(self.gamma, other.gamma)
        maps, factors = {**self.maps, **other.maps}, (*self.factors, *other.factors)
        return replace(self, name=name, factors=factors, gamma=gamma, maps=maps, **own)


def _finite(value: Tensor) -> bool:
    """Whether all values are finite; taken for granted elsewhere than on the CPU, where asking would wait."""
    return value.device.type != "cpu" or bool(value.detach().sum().isfinite())  # only if all terms are
