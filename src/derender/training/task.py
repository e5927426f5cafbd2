"""What a run trains, as the loop sees it: a model, the losses of a batch, and a watcher.

The loop decides on batches, learning rate, checkpoints and when to stop; everything else is the task's.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int64
from torch import Generator, Tensor, nn

from derender.networks.encoders import Pixels
from derender.training.distributed import Ranks
from derender.training.run_folder import RunFolder
from derender.training.watch import Finding, FiniteWatch

PhaseProgress = Callable[[int, int], None]  # called with (done, total) while a task prepares itself
Precision = Callable[[], AbstractContextManager]  # a context in which networks run


@dataclass(frozen=True)
class StepLosses:
    """Losses of one batch: ``total`` is minimised, ``terms`` are its parts and other numbers, detached."""

    total: Tensor
    terms: dict[str, Tensor]


Losses = Callable[..., StepLosses]  # of one batch, from the arguments of `compute_step` after the module


class Step(nn.Module):
    """A model with the losses of its batches, as one module that a strategy may wrap."""

    def __init__(self, model: nn.Module, losses: Losses):
        super().__init__()
        self.model, self.losses = model, losses

    def forward(self, *batch: Any) -> tuple[Tensor, Callable[[], StepLosses]]:
        result = self.losses(*batch)
        return result.total, lambda: result  # hidden from wrappers, which search the output for tensors


class TrainingTask(ABC):
    """What the loop needs to know of what it trains: a `LoopSettings`, and the methods below."""

    config: Any
    outside_loss: Any = ()  # terms by which held-out images are not judged
    replayable: ClassVar[bool] = False
    """Whether a step draws on the device of its generator and reads nothing back: then it can be recorded."""

    def shared(self, ranks: Ranks) -> "TrainingTask":
        """The same task as one of several ranks; a ValueError where it needs its batch whole."""
        raise ValueError("this is trained on one device: start it without torchrun")

    def phase(self, done: float) -> Any:
        """What steps depend on besides tensors at this share of the run; None: on what always changes."""
        return 1.0

    @abstractmethod
    def build(self) -> nn.Module:
        """The untrained model, the same for the same seed; its ``save(folder, overwrite=)`` writes it.

        It is built before there is a run folder: an error where something that the run needs is missing.
        """

    @abstractmethod
    def losses(self, model: Any, run: RunFolder, images: Pixels, progress: PhaseProgress) -> Losses:
        """The losses of a batch, by which ``model`` learns; what they need is made of all images."""

    def watch(self, memory: dict[str, Any]) -> FiniteWatch:
        """A watcher that continues from ``memory``; by default of the loss, which needs none."""
        return FiniteWatch()


def compute_step(
    module: nn.Module, images: Float[Tensor, "n 3 h w"], generator: Generator, precision: Precision,
    done: float | None = None, rows: Int64[Tensor, " n"] | None = None,
) -> Any:  # fmt: skip
    """The losses of one batch through a `Step`, wrapped by a strategy or not.

    ``done`` is the share of the run so far, None in evaluation; ``rows`` are images' places in the data set.
    """
    _, result = module(images, generator, precision, done, rows)
    return result()


def network_precision(precision: str, device: torch.device) -> Precision:
    """A context in which networks run in that precision; geometry and losses are computed outside it."""
    return nullcontext if precision == "32-true" else partial(torch.autocast, device.type, torch.bfloat16)


@dataclass(frozen=True)
class Progress:
    """Where a run stands, for a progress bar.

    ``phase`` is "perceptual" while perceptual features are learnt (``done`` of ``total`` are steps), "train",
    then "features" and "refining" (images). ``terms`` are the latest losses; ``waiting`` is the share of
    time, 0..1, spent waiting for images.
    """

    phase: str
    done: int
    total: int
    images_per_second: float = 0.0
    terms: dict[str, float] | None = None
    waiting: float = 0.0

    @classmethod
    def of(cls, phase: str, report: "Callable[[Progress], None]") -> PhaseProgress:
        """A callback of (done, total) that reports them as of one phase."""
        return lambda done, total: report(cls(phase, done, total))


@dataclass(frozen=True)
class TrainResult:
    """How a run ended.

    ``images`` seen and ``seconds`` count resumed parts. ``images_per_second`` and ``waiting`` (share of time,
    0..1, for images) are of this call. ``validation`` has the last losses by name. ``stopped`` is "images",
    "minutes", "patience" or "collapse"; ``findings`` are the watcher's last; ``model_images`` had been seen
    by the saved weights, None where that is unknown.
    """

    folder: Path
    images: int
    seconds: float
    images_per_second: float
    validation: dict[str, float]
    stopped: str
    findings: tuple[Finding, ...]
    waiting: float = 0.0
    model_images: int | None = None
