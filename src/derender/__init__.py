"""Decompose images into geometry, albedo, light and camera.

Everything public is reached from here and imported on first use, so that
``import derender`` costs no more than finding the package.
"""

import importlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from derender import evaluation as evaluate
    from derender.data.doctor import doctor
    from derender.evaluation import compare
    from derender.features import DisentangledFeatures, FeatureTable, embed, embed_to_file, search
    from derender.interpretation import explain
    from derender.learn import finetune, refine, train, unet, whiten
    from derender.model import Derenderer, load
    from derender.photo import align, decompose, relight, rotate
    from derender.scene import Scene

__version__ = "0.1.0"

_NAMES = {
    "model": ("Derenderer", "load"),
    "scene": ("Scene",),
    "data.doctor": ("doctor",),
    "features": ("FeatureTable", "DisentangledFeatures", "embed", "embed_to_file", "search"),
    "photo": ("align", "decompose", "relight", "rotate"),
    "learn": ("train", "whiten", "refine", "unet", "finetune"),
    "evaluation": ("compare",),
    "interpretation": ("explain",),
}
_HOME = {name: module for module, names in _NAMES.items() for name in names}
_SUBMODULES = [
    *("scene", "render", "data", "networks", "objectives", "model", "training", "photo", "features"),
    *("baselines", "evaluate", "evaluation", "interpretation", "report"),
]

__all__ = [
    "Derenderer", "DisentangledFeatures", "FeatureTable", "Scene", "__version__", "align", "compare",
    "decompose", "doctor", "embed", "embed_to_file", "evaluate", "explain", "finetune", "load", "refine",
    "relight", "rotate", "search", "train", "unet", "whiten",
]  # fmt: skip


def on_first_use(package: str, homes: Mapping[str, str], name: str) -> Any:
    """A name of a package, from its module among ``homes``: what a package's ``__getattr__`` gives."""
    if name not in homes:
        raise AttributeError(f"module {package!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{package}.{homes[name]}"), name)


def __getattr__(name: str) -> Any:
    if name in _SUBMODULES:
        return importlib.import_module(f"derender.{'evaluation' if name == 'evaluate' else name}")
    return on_first_use(__name__, _HOME, name)


def __dir__() -> list[str]:
    return sorted({*__all__, *_SUBMODULES})
