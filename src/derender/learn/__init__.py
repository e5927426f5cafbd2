"""Library calls that make models: train, whiten, refine, unet and finetune; each is imported on first use.

Each takes images, or the address of a data set, and writes a run folder or the folder of a model. Of several
processes that torchrun starts, the first reads the images and writes.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from derender.learn.copies import ModelCopy, refine, unet, whiten
    from derender.learn.joint import Finetuned, finetune, finetune_settings
    from derender.learn.runs import run_settings, train

__all__ = [
    "Finetuned", "ModelCopy", "finetune", "finetune_settings", "refine", "run_settings", "train", "unet",
    "whiten",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'derender.learn' has no attribute {name!r}")
    copies = "copies" if name in ("ModelCopy", "refine", "unet", "whiten") else "joint"
    module = "runs" if name in ("run_settings", "train") else copies
    return getattr(importlib.import_module(f"derender.learn.{module}"), name)
