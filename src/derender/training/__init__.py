"""Pre-training: configuration, step, loop, checkpoints and the watcher that notices collapse."""

from functools import partial
from typing import TYPE_CHECKING

from derender import on_first_use
from derender.training.config import PRESETS, TrainConfig, resolve
from derender.training.process import TrainingInterrupted
from derender.training.task import Progress, TrainResult

if TYPE_CHECKING:
    from derender.training.derender_task import train

__all__ = ["PRESETS", "Progress", "TrainConfig", "TrainResult", "TrainingInterrupted", "resolve", "train"]

# the loop and all it needs, on first use: errors of a model are read without them
__getattr__ = partial(on_first_use, __name__, {"train": "derender_task"})
