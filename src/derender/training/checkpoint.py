"""Checkpoints: weights, optimiser and counters, in files that hold no code.

A checkpoint is a folder. It is written beside the old one, read back, and then takes its place, so that a
run killed at any moment leaves a whole checkpoint behind; beside the last checkpoint of a run the one before
it is kept. Every file has a checksum.
"""

import json
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from derender.storage.atomic import CHECKSUMS, Damaged, DamageNoticed, atomic_folder, check_seal, seal
from derender.storage.tensors import disk_errors
from derender.training.run_folder import RunFolder

FORMAT = 1
WEIGHTS_FILE, OPTIMISER_FILE, STATE_FILE = "model.safetensors", "optimiser.safetensors", "state.json"


@dataclass
class TrainState:
    """Counters of a run; with the weights and the optimiser they determine everything that follows.

    Attributes:
        images: images seen so far, repeats counted.
        seconds: time spent training.
        best_loss: lowest validation loss so far, None before the first validation.
        validations_since_best: number of validations after that one.
        watcher: state of the collapse detector.
    """

    __pydantic_config__ = ConfigDict(strict=True, extra="forbid")

    images: Annotated[int, Field(ge=0, lt=1 << 62)] = 0
    seconds: Annotated[float, Field(allow_inf_nan=False)] = 0.0
    best_loss: Annotated[float, Field(allow_inf_nan=False)] | None = None
    validations_since_best: Annotated[int, Field(ge=0, lt=1 << 62)] = 0
    watcher: dict[str, Any] = field(default_factory=dict)


_COUNTERS = TypeAdapter(TrainState)


class DamagedCheckpoint(Damaged):
    """A file of a checkpoint is cut off, changed or missing; ``reason`` says which and how."""

    def __init__(self, folder: Path, reason: str):
        super().__init__(
            f"the checkpoint {folder} is damaged ({reason}), and there is no whole one before it: delete "
            f"{folder.parent} to begin this run again with --resume, or train in another folder"
        )
        self.reason = reason


def save_checkpoint(
    folder: Path,
    model: nn.Module,
    optimiser: torch.optim.Optimizer,
    state: TrainState,
    *,
    previous: Path | None = None,
) -> None:
    """Write a checkpoint to ``folder``, which takes the old one's place once it has been read back.

    The old one becomes ``previous`` where that is given, and is deleted otherwise.
    """
    weights = {name: value.detach().cpu().contiguous() for name, value in model.state_dict().items()}
    tensors, groups = _flatten(optimiser.state_dict())
    with atomic_folder(folder, previous=previous) as temporary:
        for file, values in ((WEIGHTS_FILE, weights), (OPTIMISER_FILE, tensors)):
            with disk_errors(temporary / file):
                save_file(values, temporary / file)
        described = {"format": FORMAT, "state": asdict(state), "groups": groups}
        (temporary / STATE_FILE).write_text(json.dumps(described))
        seal(temporary)
        _check_written(temporary / WEIGHTS_FILE, weights)
        _check_written(temporary / OPTIMISER_FILE, tensors)


def resume_from(
    last: Path, previous: Path, model: nn.Module, optimiser: torch.optim.Optimizer
) -> tuple[TrainState, str | None]:
    """Load the last checkpoint of a run, or the one before it where the last is damaged or gone.

    Gives the counters (of a run that has no checkpoint yet: zeros), and a sentence where it was not the last
    one, which is warned of, too.

    Raises:
        ValueError: both are damaged, or they are of another model.
    """
    if not last.exists() and not previous.exists():
        return TrainState(), None
    try:
        return load_checkpoint(last, model, optimiser), None
    except (DamagedCheckpoint, FileNotFoundError) as problem:
        if not previous.exists():
            raise
        what = f"is damaged ({problem.reason})" if isinstance(problem, DamagedCheckpoint) else "is missing"
    state = load_checkpoint(previous, model, optimiser)
    note = f"{last} {what}: going on from the checkpoint before it, of {state.images:,} images"
    warnings.warn(note, DamageNoticed, stacklevel=2)
    return state, note


def load_checkpoint(folder: Path, model: nn.Module, optimiser: torch.optim.Optimizer | None) -> TrainState:
    """Put a checkpoint's weights into ``model`` and its state into ``optimiser``; give back the counters.

    Raises:
        FileNotFoundError: there is none.
        DamagedCheckpoint: a file of it is cut off, changed or missing.
        ValueError: it is of another model, or of a newer version.
    """
    if not folder.is_dir():
        raise FileNotFoundError(
            f"no checkpoint in {folder}: train without --resume, or give the run's own folder"
        )
    stored, weights, moments = _read(folder, with_optimiser=optimiser is not None)
    try:
        state = _COUNTERS.validate_json(json.dumps(stored["state"]))
        fit_weights(model, weights)
        if optimiser is not None:
            _check_moments(optimiser, moments)
            optimiser.load_state_dict(moments)
            _lay_out_like_parameters(optimiser)
    except (ValueError, KeyError, TypeError, RuntimeError) as error:
        raise ValueError(
            f"the checkpoint {folder} is of another model ({_first_line(error)}): "
            "resume with the settings it was made with, or train in another folder"
        ) from error
    return state


def _read(folder: Path, *, with_optimiser: bool) -> tuple[dict[str, Any], dict[str, Tensor], dict[str, Any]]:
    """State, weights and the optimiser's state of a checkpoint, its checksums compared."""
    try:
        stored = json.loads((folder / STATE_FILE).read_text())
        version = stored.get("format", 0)
        if version or (folder / CHECKSUMS).exists():  # those of format 0 were not sealed
            check_seal(folder)
        if not isinstance(version, int) or version <= FORMAT:
            tensors = load_file(folder / OPTIMISER_FILE) if with_optimiser else {}
            return stored, load_file(folder / WEIGHTS_FILE), _unflatten(tensors, stored["groups"])
    except _DAMAGE as error:
        raise DamagedCheckpoint(folder, _first_line(error)) from error
    raise ValueError(
        f"the checkpoint {folder} was made in format {version}, this version reads up to {FORMAT}: "
        "update derender"
    )


def _check_moments(optimiser: torch.optim.Optimizer, moments: dict[str, Any]) -> None:
    """A state that is not of these parameters is a ValueError: a fused step goes by their size alone.

    How a step is computed is taken from the optimiser, not from the file.
    """
    own = optimiser.state_dict()["param_groups"]
    parameters = [parameter for group in optimiser.param_groups for parameter in group["params"]]
    for index, entries in moments["state"].items():
        if not 0 <= index < len(parameters) or entries.keys() != {"step", *_MOMENTS}:
            raise ValueError(f"the optimiser's state {index} holds {', '.join(sorted(entries))}")
        wanted = {"step": torch.Size(), **dict.fromkeys(_MOMENTS, parameters[index].shape)}
        for name, value in entries.items():
            if value.shape != wanted[name]:
                raise ValueError(
                    f"{index}.{name} has shape {tuple(value.shape)}, expected {tuple(wanted[name])}"
                )
    moments["param_groups"] = [
        {**mine, "params": theirs["params"]}
        for mine, theirs in zip(own, moments["param_groups"], strict=True)
    ]


_MOMENTS = ("exp_avg", "exp_avg_sq")  # Adam's
_DAMAGE = (ValueError, RecursionError, LookupError, TypeError, AttributeError, SafetensorError, OSError)
"""The errors that readers raise on files that are not as they were written."""


def _first_line(error: Exception) -> str:
    """Of its message, and of a ValidationError its first finding."""
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _check_written(file: Path, tensors: dict[str, Tensor]) -> None:
    """The file reads back bit for bit as it was to be written, or an error."""
    stored = load_file(file)
    if stored.keys() != tensors.keys() or not all(_same(stored[name], tensors[name]) for name in stored):
        raise OSError(f"{file} reads back other than it was written: check the disk; the old one is kept")


def _same(one: Tensor, other: Tensor) -> bool:
    pair = [value.contiguous().reshape(-1).view(torch.uint8) for value in (one, other)]
    return one.dtype == other.dtype and one.shape == other.shape and torch.equal(*pair)


def _lay_out_like_parameters(optimiser: torch.optim.Optimizer) -> None:
    """Give every moment the strides of its parameter: a fused optimiser walks both in memory order."""
    for parameter, entries in optimiser.state.items():
        for name, value in entries.items():
            if isinstance(value, Tensor) and value.shape == parameter.shape:
                entries[name] = torch.empty_like(parameter).copy_(value)


def _flatten(state: dict[str, Any]) -> tuple[dict[str, Tensor], list[dict[str, Any]]]:
    """An optimiser's state as named tensors and JSON values."""
    tensors = {
        f"{index}.{name}": torch.as_tensor(value).detach().cpu().contiguous()
        for index, entries in state["state"].items()
        for name, value in entries.items()
    }
    groups = [
        {key: value.tolist() if isinstance(value, Tensor) else value for key, value in group.items()}
        for group in state["param_groups"]
    ]
    return tensors, groups


def _unflatten(tensors: dict[str, Tensor], groups: list[dict[str, Any]]) -> dict[str, Any]:
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        index, name = key.split(".", 1)
        state.setdefault(int(index), {})[name] = value
    return {"state": state, "param_groups": groups}


def fit_weights(module: nn.Module, weights: Mapping[str, Tensor]) -> None:
    """Load weights by name; all of them, and no others.

    Raises:
        ValueError: one is missing, has another shape, or is not the module's; names the first.
    """
    expected = module.state_dict()
    for name, value in expected.items():
        if name not in weights:
            raise ValueError(f"it has no {name!r}, which this architecture needs")
        if weights[name].shape != value.shape:
            there, here = tuple(weights[name].shape), tuple(value.shape)
            raise ValueError(f"{name!r} has shape {there} there and {here} in this architecture")
    unknown = [name for name in weights if name not in expected]
    if unknown:
        raise ValueError(f"it has {unknown[0]!r}, which this architecture lacks")
    module.load_state_dict(dict(weights))


@dataclass
class ModelOfRun:
    """The saved model in a run's folder: with the weights of its best validation, or those of its end.

    Attributes:
        folder: of the run.
        model: the model in training.
        keep: which weights are saved.
        images: images that the saved weights had seen; None where this process saved none.
    """

    folder: RunFolder
    model: Any
    keep: Literal["best", "last"]
    images: int | None = None

    def at_best(self, images: int) -> None:
        """After the best validation so far, of weights that have seen so many images."""
        if self.keep == "best":
            self._save(images)

    def at_checkpoint(self, images: int) -> None:
        """After a checkpoint; the first one of all leaves a model in any case."""
        if self.keep == "last" or not self.folder.model.exists():
            self._save(images)

    def at_end(self, state: TrainState) -> None:
        """Make sure that a run that ends leaves the weights its settings name: on resuming they may differ.

        Where nothing was ever judged, because nothing was held out, those are of its end.
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
        self.model.save(self.folder.model, overwrite=True)
        self.images = images
