"""Pre-training: configuration, step, loop, checkpoints and the watcher that notices collapse."""

from derender.training.config import PRESETS, TrainConfig, resolve
from derender.training.interrupt import TrainingInterrupted
from derender.training.loop import Progress, TrainResult, train

__all__ = ["PRESETS", "Progress", "TrainConfig", "TrainResult", "TrainingInterrupted", "resolve", "train"]
