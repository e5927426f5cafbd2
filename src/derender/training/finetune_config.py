"""How a model is trained together with a task: the settings of pre-training, and those of the task."""

from pydantic import Field

from derender.settings import Settings
from derender.training.config import TrainConfig


class TargetSettings(Settings):
    """The task beside the rendering objective: total = rendering_weight * rendering + weight * task."""

    labels: tuple[str, ...] = ()  # label columns: one of classes, or any number of two values each
    factors: tuple[str, ...] = ("geometry", "albedo")  # whose features the head reads
    weight: float = Field(default=1.0, gt=0)
    rendering_weight: float = Field(default=1.0, ge=0)  # 0: nothing is rendered, plain fine-tuning
    labelled: int | None = Field(default=None, ge=2)  # training pictures whose labels are used; None: all


class FinetuneConfig(TrainConfig):
    """One joint training, whole."""

    start: str | None = None  # the pre-trained run or model; None: from fresh weights
    target: TargetSettings = TargetSettings()
    images: int = Field(default=100_000, ge=1)  # pictures seen, repeats counted
    validate_every: int = Field(default=5_000, ge=1)
    checkpoint_every: int = Field(default=5_000, ge=1)
