"""Which weights the model has that a run leaves: those of its best validation, or those of its end."""

import warnings
from dataclasses import dataclass
from typing import Literal, cast

from torch import nn

from derender.storage.atomic import DamageNoticed
from derender.training.checkpoint import DamagedCheckpoint, TrainState, load_checkpoint
from derender.training.run_folder import RunFolder
from derender.training.task import SavedModel


@dataclass
class KeptModel:
    """The model in a run's folder.

    Attributes:
        folder: of the run.
        model: what is trained, as it is now.
        keep: which weights are asked for.
        images: pictures that the written weights had seen; None where this process wrote none.
    """

    folder: RunFolder
    model: nn.Module
    keep: Literal["best", "last"]
    images: int | None = None

    def at_best(self, images: int) -> None:
        """After the best validation so far, of weights that have seen so many pictures."""
        if self.keep == "best":
            self._save(images)

    def at_checkpoint(self, images: int) -> None:
        """After a checkpoint; the first one of all leaves a model in any case."""
        if self.keep == "last" or not self.folder.model.exists():
            self._save(images)

    def at_end(self, state: TrainState) -> None:
        """See to it that a run that ends leaves what it was asked for: on resuming that may have changed.

        Where nothing was ever judged, because nothing was held out, that is its end.
        """
        if self.keep == "last" or state.best_loss is None:
            if self.images != state.images:
                self._save(state.images)
        elif self.images is None:
            try:
                best = load_checkpoint(self.folder.best, self.model, None)
            except (DamagedCheckpoint, FileNotFoundError):
                note = f"{self.folder.best} is damaged or missing: {self.folder.model} stays as it is"
                warnings.warn(note, DamageNoticed, stacklevel=2)
            else:
                self._save(best.images)

    def _save(self, images: int) -> None:
        cast(SavedModel, self.model).save(self.folder.model, overwrite=True)
        self.images = images
