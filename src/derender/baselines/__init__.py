"""Other ways to make a feature table, for comparison: networks that are trained here or by others, controls.

registry: one row each; model: the base of those with a network; training: their runs; controls: the others.
Names below are imported on first use, so that the registry costs nothing.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from derender.baselines.controls import control_features
    from derender.baselines.model import load_baseline
    from derender.baselines.registry import BASELINES, embed_baseline, open_baseline, train_baseline
    from derender.baselines.training import baseline_config, image_size_of, read_any_config, stored_config

_HOME = {
    **dict.fromkeys(("BASELINES", "embed_baseline", "open_baseline", "train_baseline"), "registry"),
    **dict.fromkeys(("baseline_config", "image_size_of", "read_any_config", "stored_config"), "training"),
    "control_features": "controls",
    "load_baseline": "model",
}
__all__ = [
    "BASELINES",
    "baseline_config",
    "control_features",
    "embed_baseline",
    "image_size_of",
    "load_baseline",
    "open_baseline",
    "read_any_config",
    "stored_config",
    "train_baseline",
]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"derender.baselines.{_HOME[name]}"), name)
    raise AttributeError(f"module 'derender.baselines' has no attribute {name!r}")
