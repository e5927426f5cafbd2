"""Pre-training: configuration, step, loop, checkpoints and the watcher that notices collapse."""

from derender.training.config import PRESETS, TrainConfig, resolve
from derender.training.derender_task import train
from derender.training.process import TrainingInterrupted
from derender.training.task import Progress, TrainResult

__all__ = ["PRESETS", "Progress", "TrainConfig", "TrainResult", "TrainingInterrupted", "resolve", "train"]
