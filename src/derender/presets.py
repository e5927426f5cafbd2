"""Models by name: one row each.

`paper` is the paper's model; `faces` and `cats` are the same, as unsup3d's ranges for them are. `cars` has
ranges for cars. `small` has a quarter of the widths (a sixteenth of the work) and trains on a CPU;
`small-faces` starts from a bundled model. `small-cars` has ranges for cars seen from above. How each is
trained is in training/presets.yaml.
"""

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from pydantic import Field

from derender.networks.encoders import NetworkSettings
from derender.scene.brightness import BrightnessPrior
from derender.scene.ranges import SceneRanges
from derender.settings import Settings
from derender.storage.places import require_known

T = TypeVar("T")


class ModelSettings(Settings):
    """Everything that decides what a model computes, apart from its weights."""

    network: NetworkSettings = NetworkSettings()
    ranges: SceneRanges = SceneRanges()
    renderer: str = Field(default="lambert", max_length=200)  # by name (renderers/): its factors are learnt
    brightness: BrightnessPrior | None = None  # estimated after training; `decompose` applies it

    def grown(self, image_size: int) -> "ModelSettings":
        """The settings of such a model after growing to a larger image size."""
        sizes: dict[str, Any] = {"image_size": image_size, "grown_from": self.network.encoded_size}
        return self.model_copy(update={"network": NetworkSettings(**{**self.network.model_dump(), **sizes})})

    def description(self, factors: Sequence[str]) -> str:
        """Two sentences for a model's card: factors and renderer; sizes and ranges."""
        network, ranges = self.network, self.ranges
        return (
            f"Decomposes {network.image_size} x {network.image_size} images of one kind of object into "
            f"{', '.join(factors[:-1])} and {factors[-1]}, drawn by the renderer `{self.renderer}`. "
            f"Field of view {ranges.fov_deg:g} degrees; depth {ranges.depth_min:g} to {ranges.depth_max:g}; "
            f"networks of width {network.width} and {network.light_width}; codes of {network.code_size}."
        )


_SMALL = ModelSettings(network=NetworkSettings(width=16, light_width=8))
_FROM_ABOVE = SceneRanges(border_depth=1.08, diffuse=(0.5, 1.0), level_depth=True, lean_deg=35)
MODEL_PRESETS: dict[str, ModelSettings] = {
    **dict.fromkeys(("paper", "faces", "cats"), ModelSettings()),
    "cars": ModelSettings(ranges=SceneRanges(border_depth=1.08, diffuse=(0.5, 1.0))),
    **dict.fromkeys(("small", "small-faces"), _SMALL),
    "small-cars": _SMALL.model_copy(update={"ranges": _FROM_ABOVE}),
}


def named_preset(name: str, presets: Mapping[str, T]) -> T:
    """The preset of that name, or an error that names the nearest one."""
    require_known("preset", name, tuple(presets))
    return presets[name]
