"""The folder of a saved model: its files, its ``config.json``, whether weights fit."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import torch
from pydantic import Field, NonNegativeFloat, NonNegativeInt, field_validator
from torch import Tensor, nn

from derender.settings import Settings
from derender.storage.atomic import write_whole
from derender.storage.bounded import first_line, read_json, read_text
from derender.storage.places import CONFIG_FILE, SPLIT_FILE, TENSOR_FILES, TEXT_FILES, WEIGHTS_FILE
from derender.storage.tensors import check_fit, read_tensors

Net = TypeVar("Net", bound=nn.Module)

FORMAT = 1
QUANTILES = 101


def texts_beside(folder: Path | None, tensors: Mapping[str, Tensor]) -> dict[str, str]:
    """Card, held-out errors and split of a saved folder, by file, if its files hold these tensors."""
    if folder is None or not (folder / WEIGHTS_FILE).is_file():
        return {}
    stored: dict[str, Tensor] = {}
    for name in TENSOR_FILES:
        stored |= read_tensors(folder / name) if (folder / name).is_file() else {}
    equal = (name in stored and torch.equal(stored[name].to(own), own) for name, own in tensors.items())
    if len(stored) != len(tensors) or not all(equal):
        return {}
    files = (folder / name for name in TEXT_FILES)
    return {file.name: read_text(file) for file in files if file.is_file()}


def saved_config(folder: Path) -> dict[str, Any]:
    """``config.json`` of a saved model or baseline, with its ``settings``; ValueError if damaged or newer."""
    config = read_json(folder / CONFIG_FILE, dict[str, Any])
    version = config.get("format")
    if isinstance(version, int) and version > FORMAT:
        newer = f"was saved in format {version}, this version reads up to {FORMAT}"
        raise ValueError(f"{folder} {newer}: update derender")
    if version != FORMAT or not isinstance(config.get("settings"), dict):
        raise ValueError(f"{folder / CONFIG_FILE} is damaged: copy or train the model again")
    return config


def read_config(folder: Path) -> dict[str, Any]:
    """``factors`` and ``settings`` of a saved model; ValueError: damaged, newer, or of a baseline."""
    config = saved_config(folder)
    if "baseline" in config:
        name = config["baseline"]
        fix = f"add --baseline {name}, or load it with derender.baselines.load_baseline"
        raise ValueError(f"{folder} holds the baseline {name!r}, not our model: {fix}")
    names = config.get("factors")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"{folder / CONFIG_FILE} is damaged: copy or train the model again")
    return config


def write_config(folder: Path, factors: Sequence[str], settings: Settings) -> None:
    """Write a saved model's ``config.json``; complete or not at all."""
    config = {"format": FORMAT, "factors": list(factors), "settings": settings.model_dump(mode="json")}
    write_whole(folder / CONFIG_FILE, json.dumps(config, indent=1))


def read_weights(folder: Path, build: Callable[[], Net]) -> Net:
    """The network that ``build`` makes, with the weights of a saved folder; damage is a ValueError."""
    with torch.device("meta"):  # sizes are compared before memory is taken for what the file only claims
        expected = build().state_dict()
    check_fit(weights := read_tensors(folder / WEIGHTS_FILE, like=expected), expected)
    network = build()
    network.load_state_dict(weights)
    return network


@contextmanager
def naming_damage(folder: Path) -> Iterator[None]:
    """Turn what a damaged file raises into one sentence that names the folder."""
    try:
        yield
    except (RuntimeError, ValueError) as error:
        why = first_line(error)
        raise ValueError(f"{folder} is damaged ({why}): copy or train the model again") from error


class HeldOutErrors(Settings):
    """Errors of held-out images: the masked L1 (0..1) that 0, 1, ... 100 % of them do not exceed."""

    format: Literal[1] = 1
    measure: str = "mean absolute difference inside the mask, 0..1"
    pictures: NonNegativeInt
    quantiles: list[NonNegativeFloat] = Field(min_length=QUANTILES, max_length=QUANTILES)

    @field_validator("quantiles")
    @classmethod
    def _ascending(cls, values: list[float]) -> list[float]:
        if sorted(values) != values:
            raise ValueError("quantiles do not ascend")
        return values


@dataclass(frozen=True)
class SplitRecord:
    """Which images a model was not trained on: its run's shares of training, validation, test, and seed.

    Parts are drawn from files' names (``data.splits``), so that these define them.
    """

    shares: tuple[float, float, float]
    seed: int
    format: Literal[1] = 1


def write_split(folder: Path, split: SplitRecord) -> None:
    """Write the file into a saved model's folder; complete or not at all."""
    write_whole(folder / SPLIT_FILE, json.dumps(asdict(split)) + "\n")


def read_split(folder: Path) -> SplitRecord | None:
    """The split recorded with the model in ``folder``; None without, a ValueError where it is damaged."""
    file = folder / SPLIT_FILE
    if not file.is_file():
        return None
    stored: SplitRecord = read_json(file, SplitRecord, "take the model again, or update derender")
    if abs(sum(stored.shares) - 1) > 1e-6:
        raise ValueError(f"{file} is damaged or of a newer version: its shares sum to {sum(stored.shares):g}")
    return stored
