"""Checkpoints: weights, optimiser and counters, in files that hold no code.

A checkpoint is a folder of files with checksums. It is written beside the old one, read back, and then takes
its place: a kill at any moment leaves a whole one behind. The last but one is kept, too.
"""

import json
import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter
from safetensors.torch import save
from torch import Tensor, nn

from derender.storage.atomic import CHECKSUMS, Damaged, DamageNoticed, atomic_folder, check_seal, seal
from derender.storage.bounded import first_line, parse_json, read_bounded
from derender.storage.tensors import check_fit, read_tensors

FORMAT = 1
WEIGHTS_FILE, OPTIMISER_FILE, STATE_FILE = "model.safetensors", "optimiser.safetensors", "state.json"

_MOMENTS = ("exp_avg", "exp_avg_sq")  # Adam's


@dataclass
class TrainState:
    """Counters of a run so far; with the weights and the optimiser they determine everything that follows."""

    __pydantic_config__ = ConfigDict(strict=True, extra="forbid")

    images: Annotated[int, Field(ge=0, lt=1 << 62)] = 0
    seconds: Annotated[float, Field(allow_inf_nan=False)] = 0.0
    best_loss: Annotated[float, Field(allow_inf_nan=False)] | None = None  # None before the first validation
    validations_since_best: Annotated[int, Field(ge=0, lt=1 << 62)] = 0
    watcher: dict[str, Any] = field(default_factory=dict)  # the state of the collapse detector
    compiled: bool | None = None  # whether networks are; None where that was never asked for

    def expected_images(self, config: Any) -> int:
        """Images of the whole run: those of its settings, or fewer that its minutes leave time for."""
        if config.minutes is None or not self.images * self.seconds:
            return config.images
        return round(min(config.images, self.images * 60 * config.minutes / self.seconds))

    def ended_by(self, config: Any) -> str | None:
        """The setting that lets a run with these counters train no further, if there is one."""
        if self.images >= config.images:
            return "images"
        if config.minutes is not None and self.seconds >= 60 * config.minutes:
            return "minutes"
        return "patience" if self.validations_since_best >= config.patience else None


class _StateFile(BaseModel):
    format: int = 0
    state: dict[str, Any]


class DamagedCheckpoint(Damaged):
    """A file of a checkpoint is cut off, changed or missing; ``reason`` says which and how."""

    def __init__(self, folder: Path, reason: str):
        what = f"the checkpoint {folder} is damaged ({reason}), and there is no whole one before it"
        fix = f"delete {folder.parent} to begin this run again with --resume, or train in another folder"
        super().__init__(f"{what}: {fix}")
        self.reason = reason


def save_checkpoint(
    folder: Path, model: nn.Module, optimiser: torch.optim.Optimizer, state: TrainState, *,
    previous: Path | None = None,
) -> None:  # fmt: skip
    """Write a checkpoint, read it back, put it in place of ``folder``; the old one becomes ``previous``."""
    kept = optimiser.state_dict()
    moments = {f"{i}.{name}": value for i, row in kept["state"].items() for name, value in row.items()}
    with atomic_folder(folder, previous=previous) as temporary:
        for name, tensors in ((WEIGHTS_FILE, model.state_dict()), (OPTIMISER_FILE, moments)):
            content = save({key: value.detach().cpu().contiguous() for key, value in tensors.items()})
            (temporary / name).write_bytes(content)
            if (temporary / name).read_bytes() != content:
                other = f"{temporary / name} reads back other than it was written"
                raise OSError(f"{other}: check the disk; the old one is kept")
        described = {"format": FORMAT, "state": asdict(state), "groups": kept["param_groups"]}
        (temporary / STATE_FILE).write_text(json.dumps(described, default=float))  # a rate on the device
        seal(temporary)


def resume_from(
    last: Path, previous: Path, model: nn.Module, optimiser: torch.optim.Optimizer
) -> tuple[TrainState, str | None]:
    """Load the last checkpoint of a run, or the one before it where the last is damaged or gone.

    Gives the counters (without any checkpoint zeros), and a sentence, also a warning, where it was not last.
    Errors are those of `load_checkpoint`.
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


def read_state(folder: Path) -> TrainState:
    """The counters of a checkpoint; without a whole file of them zeros."""
    with suppress(ValueError, OSError):
        stored = parse_json(read_bounded(folder / STATE_FILE), _StateFile)
        return TypeAdapter(TrainState).validate_json(json.dumps(stored.state))
    return TrainState()


def load_checkpoint(folder: Path, model: nn.Module, optimiser: torch.optim.Optimizer | None) -> TrainState:
    """Put a checkpoint's weights into ``model`` and its state into ``optimiser``; give back the counters.

    A FileNotFoundError: there is none; a DamagedCheckpoint: a file of it is cut off, changed or missing; a
    ValueError: it is of another model, or of a newer version.
    """
    if not folder.is_dir():
        fix = "train without --resume, or give the run's own folder"
        raise FileNotFoundError(f"no checkpoint in {folder}: {fix}")
    try:
        stored = parse_json(read_bounded(folder / STATE_FILE), _StateFile)
        version = stored.format
        if version or (folder / CHECKSUMS).exists():  # those of format 0 were not sealed
            check_seal(folder)
        newer, own = version > FORMAT, model.state_dict()
        weights = {} if newer else read_tensors(folder / WEIGHTS_FILE, like=own)
        moments = {} if newer or optimiser is None else read_tensors(folder / OPTIMISER_FILE, like=own)
    except (ValueError, OSError) as error:
        raise DamagedCheckpoint(folder, first_line(error)) from error
    if newer:
        made = f"was made in format {version}, this version reads up to {FORMAT}"
        raise ValueError(f"the checkpoint {folder} {made}: update derender")
    try:
        state = TypeAdapter(TrainState).validate_json(json.dumps(stored.state))
        fit_weights(model, weights)
        if optimiser is not None:
            _fit_moments(optimiser, moments)
    except (ValueError, RuntimeError) as error:
        why, fix = first_line(error), "resume with the settings it was made with, or train in another folder"
        raise ValueError(f"the checkpoint {folder} is of another model ({why}): {fix}") from error
    return state


def fit_weights(module: nn.Module, weights: Mapping[str, Tensor]) -> None:
    """Load weights by name; one that is missing, has another shape or is strange is a ValueError."""
    check_fit(weights, module.state_dict())
    module.load_state_dict(dict(weights))


def _fit_moments(optimiser: torch.optim.Optimizer, moments: Mapping[str, Tensor]) -> None:
    """Give the optimiser a stored state, with the strides of its parameters; how it steps stays its own."""
    parameters = [parameter for group in optimiser.param_groups for parameter in group["params"]]
    result: dict[int, dict[str, Tensor]] = {}
    for key, value in moments.items():
        index, _, name = key.partition(".")
        result.setdefault(int(index), {})[name] = value
    optimiser.state.clear()
    for index, entries in result.items():
        if not 0 <= index < len(parameters) or entries.keys() != {"step", *_MOMENTS}:
            raise ValueError(f"the optimiser's state {index} holds {', '.join(sorted(entries))}")
        own = parameters[index]
        for name, value in entries.items():
            wanted = torch.Size() if name == "step" else own.shape
            if value.shape != wanted:  # a fused step goes by the parameter's size alone
                raise ValueError(f"{index}.{name} has shape {tuple(value.shape)}, expected {tuple(wanted)}")
        step = entries["step"].to(own.device, torch.float32)
        likened = {name: torch.empty_like(own).copy_(entries[name]) for name in _MOMENTS}
        optimiser.state[own] = {"step": step, **likened}
