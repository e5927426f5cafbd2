"""Models by name: one row each.

`paper` is the paper's model; `faces`, `cats` and `cars` are the same networks with the ranges that suit
the kind of thing; `small` has a quarter of the widths (a sixteenth of the work) and trains on a CPU.
How each is trained stands in training/config.py under the same names.
"""

from collections.abc import Mapping
from typing import TypeVar

from derender.data import suggestion
from derender.networks.settings import NetworkSettings
from derender.scene.ranges import SceneRanges
from derender.settings import Settings

T = TypeVar("T")


class ModelSettings(Settings):
    """Everything that decides what a model computes, apart from its weights."""

    network: NetworkSettings = NetworkSettings()
    ranges: SceneRanges = SceneRanges()


MODEL_PRESETS: dict[str, ModelSettings] = {
    "paper": ModelSettings(),
    "faces": ModelSettings(),
    "cats": ModelSettings(),
    "cars": ModelSettings(ranges=SceneRanges(border_depth=1.08, diffuse=(0.5, 1.0))),
    "small": ModelSettings(network=NetworkSettings(width=16, light_width=8)),
}


def named_preset(name: str, presets: Mapping[str, T]) -> T:
    """The preset of that name, or an error that names the nearest one."""
    if name not in presets:
        raise ValueError(f"no preset {name!r}{suggestion(name, presets)}: choose one of {', '.join(presets)}")
    return presets[name]
