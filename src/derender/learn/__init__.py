"""Library calls that make models: train, whiten, refine, unet, finetune; and compare_plan, many of them.

Each is imported on first use. It takes images or the address of a data set, and writes a run folder or the
folder of a model. Of several processes that torchrun starts, the first reads the images and writes.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from derender.learn.copies import ModelCopy, copy_settings, refine, unet, whiten
    from derender.learn.runs import Finetuned, finetune, finetune_settings, run_settings, train
    from derender.learn.sweep import compare_plan

__all__ = [
    "Finetuned", "ModelCopy", "compare_plan", "copy_settings", "finetune", "finetune_settings", "refine",
    "run_settings", "train", "unet", "whiten",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'derender.learn' has no attribute {name!r}")
    homes = {"copies": ("ModelCopy", "copy_settings", "refine", "unet", "whiten"), "sweep": ("compare_plan",)}
    module = next((home for home, names in homes.items() if name in names), "runs")
    return getattr(importlib.import_module(f"derender.learn.{module}"), name)
