"""Pre-training: configuration, step, loop, checkpoints and the watcher that notices collapse."""

from typing import TYPE_CHECKING, Any

from derender.training.config import PRESETS, TrainConfig, resolve
from derender.training.process import TrainingInterrupted
from derender.training.task import Progress, TrainResult

if TYPE_CHECKING:
    from derender.training.derender_task import train

__all__ = ["PRESETS", "Progress", "TrainConfig", "TrainResult", "TrainingInterrupted", "resolve", "train"]


def __getattr__(name: str) -> Any:
    if name == "train":  # the loop and all it needs, on first use: errors of a model are read without them
        from derender.training.derender_task import train

        return train
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
