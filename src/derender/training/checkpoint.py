"""Checkpoints: weights, optimiser and counters, in files that hold no code.

A checkpoint is a folder. It is written beside the old one and then takes its place, so that a run killed at
any moment leaves a whole checkpoint behind.
"""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from derender.training.weights import fit_weights
from derender.whole import whole_folder

WEIGHTS_FILE, OPTIMISER_FILE, STATE_FILE = "model.safetensors", "optimiser.safetensors", "state.json"


@dataclass
class TrainState:
    """Counters of a run; with the weights and the optimiser they determine everything that follows.

    Attributes:
        images: pictures seen so far, repeats counted.
        seconds: time spent training.
        best_loss: lowest validation loss so far, None before the first validation.
        validations_since_best: how many validations ago that was.
        watcher: what the collapse detector remembers.
    """

    images: int = 0
    seconds: float = 0.0
    best_loss: float | None = None
    validations_since_best: int = 0
    watcher: dict[str, Any] = field(default_factory=dict)


def save_checkpoint(
    folder: Path, model: nn.Module, optimiser: torch.optim.Optimizer, state: TrainState
) -> None:
    """Write a checkpoint to ``folder``, replacing the one that is there only once the new one is whole."""
    weights = {name: value.detach().cpu().contiguous() for name, value in model.state_dict().items()}
    tensors, groups = _flatten(optimiser.state_dict())
    with whole_folder(folder) as temporary:
        save_file(weights, temporary / WEIGHTS_FILE)
        save_file(tensors, temporary / OPTIMISER_FILE)
        (temporary / STATE_FILE).write_text(json.dumps({"state": asdict(state), "groups": groups}))


def load_checkpoint(folder: Path, model: nn.Module, optimiser: torch.optim.Optimizer | None) -> TrainState:
    """Put a checkpoint's weights into ``model`` and its state into ``optimiser``; give back the counters.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is damaged, or of another model.
    """
    if not (folder / STATE_FILE).is_file():
        raise FileNotFoundError(
            f"no checkpoint in {folder}: train without --resume, or give the run's own folder"
        )
    try:
        stored = json.loads((folder / STATE_FILE).read_text())
        state = TrainState(**stored["state"])
        fit_weights(model, load_file(folder / WEIGHTS_FILE))
        if optimiser is not None:
            optimiser.load_state_dict(_unflatten(load_file(folder / OPTIMISER_FILE), stored["groups"]))
            _lay_out_like_parameters(optimiser)
    except (
        ValueError,
        KeyError,
        TypeError,
        SafetensorError,
        RuntimeError,
        OSError,
    ) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(
            f"the checkpoint {folder} is damaged or of another model ({reason}): "
            "delete it to fall back on checkpoints/best, or train again"
        ) from error
    return state


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
