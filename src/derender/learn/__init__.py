"""Library calls that make models: train, whiten, refine, unet, finetune; and compare_plan, many of them.

Each is imported on first use. It takes images or the address of a data set, and writes a run folder or the
folder of a model. Of several processes that torchrun starts, the first reads the images and writes.
"""

from functools import partial
from typing import TYPE_CHECKING

from derender import on_first_use

if TYPE_CHECKING:
    from derender.learn.copies import ModelCopy, copy_settings, refine, unet, whiten
    from derender.learn.runs import Finetuned, finetune, finetune_settings, run_settings, train
    from derender.learn.sweep import compare_plan

__all__ = [
    "Finetuned", "ModelCopy", "compare_plan", "copy_settings", "finetune", "finetune_settings", "refine",
    "run_settings", "train", "unet", "whiten",
]  # fmt: skip

_COPIES = ("ModelCopy", "copy_settings", "refine", "unet", "whiten")
_HOME = {**dict.fromkeys(__all__, "runs"), **dict.fromkeys(_COPIES, "copies"), "compare_plan": "sweep"}
__getattr__ = partial(on_first_use, __name__, _HOME)
