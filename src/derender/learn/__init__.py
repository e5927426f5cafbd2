"""Library calls that make models: train, whiten, refine, unet and finetune.

Each takes images, or the address of a data set, and writes a run folder or the folder of a model. Of several
processes that torchrun starts, the first reads the images and writes.
"""

from derender.learn.copies import ModelCopy, refine, unet, whiten
from derender.learn.joint import Finetuned, finetune, finetune_settings
from derender.learn.runs import run_settings, train

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
