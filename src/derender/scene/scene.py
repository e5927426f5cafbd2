"""The value that travels through the left half of the program: one batch of scenes.

Conventions (axes, signs, units) are written in docs/reference/conventions.md.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from derender.scene.environment import main_light

_FIELDS = ("depth", "albedo", "light", "camera")
_SIGNS = {  # in a mirror
    "light": (1.0, 1.0, 1.0, -1.0),  # ambient, diffuse, pitch, yaw
    "camera": (1.0, -1.0, -1.0, -1.0, 1.0, 1.0),  # rotation about x, y, z; translation along x, y, z
    "environment": (1.0, 1.0, 1.0, -1.0, -1.0, 1.0, 1.0, -1.0, 1.0),  # of each channel
}


@dataclass(frozen=True)
class Scene:
    """A batch of N scenes, each one object seen by one camera under one light.

    Attributes:
        depth: (N, H, W) z of the canonical surface, metric, seen from the camera (0.9..1.1 in the presets).
        albedo: (N, 3, H, W) reflectance in the canonical view, 0..1.
        light: (N, 4) ambient, diffuse (both 0..1), pitch, yaw (radians; 0, 0 is frontal).
        camera: (N, 6) rotation about x, y, z (radians, about the point (0, 0, 1)), translation along x, y, z.
        extra: parameters of factors beyond these four, by name, each with N rows. An ``environment``
            (scene/environment.py) is all of the light, and ``light`` is its main one.
    """

    depth: Float[Tensor, "n h w"]
    albedo: Float[Tensor, "n 3 h w"]
    light: Float[Tensor, "n 4"]
    camera: Float[Tensor, "n 6"]
    extra: Mapping[str, Tensor] = field(default_factory=dict)

    @classmethod
    def from_parameters(cls, parameters: Mapping[str, Tensor]) -> "Scene":
        """Gather parameters by name; names other than the four fields go to ``extra``.

        Without a light, it is the main one of the environment.
        """
        if "environment" in parameters and "light" not in parameters:
            parameters = {**parameters, "light": main_light(parameters["environment"])}
        if missing := [name for name in _FIELDS if name not in parameters]:
            raise ValueError(f"a scene needs {', '.join(_FIELDS)}; missing: {', '.join(missing)}")
        extra = {name: value for name, value in parameters.items() if name not in _FIELDS}
        return cls(*(parameters[name] for name in _FIELDS), extra=extra)

    @property
    def parameters(self) -> dict[str, Tensor]:
        """Every parameter by name, extras last."""
        return {**{name: getattr(self, name) for name in _FIELDS}, **self.extra}

    @property
    def lighting(self) -> dict[str, Tensor]:
        """All of the light, by name: the environment, where there is one, else ``light``."""
        name = "environment" if "environment" in self.extra else "light"
        return {name: self.parameters[name]}

    @classmethod
    def joined(cls, scenes: "Sequence[Scene]") -> "Scene":
        """Batches of scenes one after the other."""
        parts = [scene.parameters for scene in scenes]
        return cls.from_parameters({name: torch.cat([part[name] for part in parts]) for name in parts[0]})

    def with_parameters(self, **changed: Tensor) -> "Scene":
        """The same scenes with some parameters exchanged; an unknown name is an error.

        A light takes the place of an environment, and an environment brings its main light.
        """
        kept = self.parameters
        if unknown := sorted(set(changed) - set(kept)):
            raise ValueError(f"unknown scene parameter {unknown[0]!r}; this scene has {', '.join(kept)}")
        for one, other in (("light", "environment"), ("environment", "light")):
            if one in changed and other not in changed and "environment" in kept:
                del kept[other]
        return Scene.from_parameters({**kept, **changed})

    def map(self, function: Callable[[Tensor], Tensor]) -> "Scene":
        """Apply one function to every parameter."""
        return Scene.from_parameters({name: function(value) for name, value in self.parameters.items()})

    def to(self, device) -> "Scene":
        return self.map(lambda value: value.to(device))

    def detach(self) -> "Scene":
        return self.map(lambda value: value.detach())

    def __getitem__(self, rows) -> "Scene":
        """Select scenes by slice, list or index tensor; an integer keeps the batch axis."""
        if isinstance(rows, int):
            rows = slice(rows, rows + 1 or None)
        return self.map(lambda value: value[rows])

    def __len__(self) -> int:
        return self.depth.shape[0]


def seen_in_mirror(scene: Scene, even: Collection[str] = ()) -> Scene:
    """Scenes whose images are the mirror images of these scenes' images.

    ``even`` are further parameters that stay as they are; those that are not known are a ValueError.
    """
    twin = {**scene.parameters, "depth": scene.depth.flip(-1), "albedo": scene.albedo.flip(-1)}
    for name, value in scene.parameters.items():
        if name in _SIGNS:
            twin[name] = value * value.new_tensor(_SIGNS[name] * (value.shape[1] // len(_SIGNS[name])))
        elif name in scene.extra and name not in even:
            raise ValueError(f"what a mirror does to {name} is not known")
    return Scene.from_parameters(twin)
