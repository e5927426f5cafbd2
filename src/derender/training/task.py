"""What a run trains, as the loop sees it: a model, the losses of a batch, and what to look out for.

The loop decides on batches, learning rate, checkpoints and when to stop; everything else is the task's. Our
own model is one task (derender_task.py), the trained baselines are others.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from jaxtyping import UInt8
from torch import Tensor, nn

from derender.training.config import LoopSettings
from derender.training.run_folder import RunFolder
from derender.training.watch import Finding

PhaseProgress = Callable[[int, int], None]
"""Called with (done, total) while a task prepares itself."""


@runtime_checkable
class StepLosses(Protocol):
    """Losses of one batch: ``total`` is minimised, ``terms`` are its parts and other numbers, detached."""

    @property
    def total(self) -> Tensor: ...
    @property
    def terms(self) -> dict[str, Tensor]: ...


@runtime_checkable
class SavedModel(Protocol):
    """A model that knows how to lie in a folder."""

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path: ...


@runtime_checkable
class Watch(Protocol):
    """Looks at every step and says what is wrong; remembers, so that a resumed run goes on watching."""

    @property
    def uneasy(self) -> bool:
        """Whether the present state is no good checkpoint."""
        ...

    def look(self, images: int, result: Any) -> tuple[Finding, ...]: ...
    def memory(self) -> dict[str, Any]: ...


@runtime_checkable
class Task(Protocol):
    """What the loop needs to know of what it trains."""

    @property
    def config(self) -> LoopSettings:
        """How the run goes."""
        ...

    @property
    def outside_loss(self) -> tuple[str, ...]:
        """Names of terms that held-out pictures are not judged by."""
        ...

    def check(self) -> None:
        """Raise what is missing, before a run folder is made."""
        ...

    def build(self) -> nn.Module:
        """The untrained model, the same for the same seed; it is also a `SavedModel`."""
        ...

    def step_module(
        self,
        model: nn.Module,
        run: RunFolder,
        images: UInt8[Tensor, "n 3 h w"],
        progress: PhaseProgress,
    ) -> nn.Module:
        """A module ``(pictures, generator, precision, done) -> (total, Held)``; its ``model`` is the model.

        ``images`` are all training pictures, on the device.
        """
        ...

    def watch(self, memory: dict[str, Any]) -> Watch | None:
        """A watcher that goes on from ``memory``, or None."""
        ...
