"""The folder of a saved model: its files, its ``config.json``, whether weights fit."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from derender.storage.atomic import atomic_file
from derender.storage.places import (
    CONFIG_FILE,
    SPLIT_FILE,
    TENSOR_FILES,
    TEXT_FILES,
    WEIGHTS_FILE,
)  # fmt: skip
from derender.storage.tensors import check_fit, read_tensors, write_tensors

Net = TypeVar("Net", bound=nn.Module)

FORMAT = SPLIT_FORMAT = 1


def texts_beside(folder: Path | None, tensors: Mapping[str, Tensor]) -> dict[str, str]:
    """Card, held-out errors and split of a saved folder, by file, if its files hold these tensors."""
    if folder is None or not (folder / WEIGHTS_FILE).is_file():
        return {}
    stored: dict[str, Tensor] = {}
    for name in TENSOR_FILES:
        stored |= read_tensors(folder / name) if (folder / name).is_file() else {}
    if stored.keys() != tensors.keys() or any(
        not torch.equal(stored[name].to(value), value) for name, value in tensors.items()
    ):
        return {}
    files = (folder / name for name in TEXT_FILES)
    return {file.name: file.read_text(encoding="utf-8") for file in files if file.is_file()}


def saved_config(folder: Path) -> dict[str, Any]:
    """``config.json`` of a saved model or baseline, with its ``settings``; ValueError if damaged or newer."""
    damaged = f"{folder / CONFIG_FILE} is damaged: copy or train the model again"
    try:
        config = json.loads((folder / CONFIG_FILE).read_text())
        version, settings = config["format"], config.get("settings")
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(damaged) from error
    if not isinstance(version, int) or version > FORMAT:
        raise ValueError(
            f"{folder} was saved in format {version}, this version reads up to {FORMAT}: update derender"
        )
    if not isinstance(settings, dict):
        raise ValueError(damaged)
    return config


def read_config(folder: Path) -> dict[str, Any]:
    """``config.json`` of a saved model: its ``factors`` and ``settings``.

    A ValueError: it is damaged, of a newer version, or of a baseline.
    """
    config = saved_config(folder)
    if "baseline" in config:
        name = config["baseline"]
        raise ValueError(
            f"{folder} holds the baseline {name!r}, not our model: add --baseline {name}, or load it with "
            "derender.baselines.load_baseline"
        )
    names = config.get("factors")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"{folder / CONFIG_FILE} is damaged: copy or train the model again")
    return config


def check_factors(folder: Path, config: Mapping[str, Any], factors: Sequence[str]) -> None:
    """A ValueError where a saved model's configuration is of other factors."""
    names = config["factors"]
    if names != list(factors):
        raise ValueError(
            f"{folder} holds factors {', '.join(names)}, asked for {', '.join(factors)}: "
            "pass its rows as factors="
        )


def write_model(
    folder: Path, factors: Sequence[str], settings: Mapping[str, Any], weights: Mapping[str, Tensor]
) -> None:
    """Write configuration and weights into a folder that exists."""
    write_tensors(weights, folder / WEIGHTS_FILE)
    write_config(folder, factors, settings)


def write_config(folder: Path, factors: Sequence[str], settings: Mapping[str, Any]) -> None:
    """Write a saved model's ``config.json``; complete or not at all."""
    with atomic_file(folder / CONFIG_FILE) as temporary:
        temporary.write_text(
            json.dumps({"format": FORMAT, "factors": list(factors), "settings": settings}, indent=1)
        )


def read_weights(folder: Path, build: Callable[[], Net]) -> Net:
    """The network that ``build`` makes, with the weights of a saved folder; damage is a ValueError."""
    weights = read_tensors(folder / WEIGHTS_FILE)
    with torch.device("meta"):  # sizes are compared before memory is taken for what the file only claims
        check_fit(weights, build().state_dict())
    network = build()
    network.load_state_dict(weights)
    return network


@contextmanager
def naming_damage(folder: Path) -> Iterator[None]:
    """Turn what a damaged file raises into one sentence that names the folder."""
    try:
        yield
    except (RuntimeError, ValueError) as error:
        raise ValueError(
            f"{folder} is damaged ({str(error).splitlines()[0]}): copy or train the model again"
        ) from error


@dataclass(frozen=True)
class SplitRecord:
    """Which images a model was not trained on: its run's shares of training, validation, test, and seed.

    Parts are drawn from files' names (``data.splits``), so that these define them.
    """

    shares: tuple[float, float, float]
    seed: int


def write_split(folder: Path, split: SplitRecord) -> None:
    """Write the file into a saved model's folder; complete or not at all."""
    with atomic_file(folder / SPLIT_FILE) as temporary:
        temporary.write_text(json.dumps({"format": SPLIT_FORMAT, **asdict(split)}) + "\n")


def read_split(folder: Path) -> SplitRecord | None:
    """The split recorded with the model in ``folder``; None without, a ValueError where it is damaged."""
    file = folder / SPLIT_FILE
    if not file.is_file():
        return None
    try:
        values = json.loads(file.read_text())
        train, validation, test = (float(share) for share in values["shares"])
        if values["format"] == SPLIT_FORMAT and abs(train + validation + test - 1) < 1e-6:
            return SplitRecord((train, validation, test), int(values["seed"]))
    except (KeyError, TypeError, ValueError):
        pass
    raise ValueError(f"{file} is damaged or of a newer version: take the model again, or update derender")
