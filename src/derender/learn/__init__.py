"""Library calls that make models: train, whiten, refine, unet and finetune.

Each takes images, or the address of a data set, and writes a run folder or the folder of a model. Of several
processes that torchrun starts, the first reads the images and writes.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from derender.learn.copies import ModelCopy, refine, unet, whiten
    from derender.learn.joint import Finetuned, finetune, finetune_settings
    from derender.learn.runs import run_settings, train

_HOME = {
    **dict.fromkeys(("run_settings", "train"), "runs"),
    **dict.fromkeys(("ModelCopy", "refine", "unet", "whiten"), "copies"),
    **dict.fromkeys(("Finetuned", "finetune", "finetune_settings"), "joint"),
}

__all__ = [
    "Finetuned",
    "ModelCopy",
    "finetune",
    "finetune_settings",
    "refine",
    "run_settings",
    "train",
    "unet",
    "whiten",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'derender.learn' has no attribute {name!r}")
    return getattr(importlib.import_module(f"derender.learn.{_HOME[name]}"), name)
