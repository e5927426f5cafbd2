"""The folder of a saved model: names of its files, what ``config.json`` must say, whether weights fit."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

FORMAT = 1
WEIGHTS_FILE, CONFIG_FILE = "model.safetensors", "config.json"
WHITENING_FILE, FITTING_FILE = "whitening.safetensors", "fitting.safetensors"  # a model may lack them
ERRORS_FILE = "held_out_errors.json"  # written and read by training/held_out_errors.py; a model may lack it
SPLIT_FILE = "split.json"  # written and read by pretrained/split_record.py; a model may lack it


def read_config(folder: Path) -> dict[str, Any]:
    """What a saved folder says of its model: ``factors`` and ``settings``.

    Raises:
        ValueError: it is damaged, of a newer version, or of a baseline.
    """
    try:
        config = json.loads((folder / CONFIG_FILE).read_text())
        version, complete = config["format"], isinstance(config.get("settings"), dict)
        names = config.get("factors")
        complete = complete and isinstance(names, list) and all(isinstance(name, str) for name in names)
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{folder / CONFIG_FILE} is damaged: copy or train the model again") from error
    if "baseline" in config:
        name = config["baseline"]
        raise ValueError(
            f"{folder} holds the baseline {name!r}, not our model: add --baseline {name}, or load it with "
            "derender.baselines.training.load_baseline"
        )
    if not isinstance(version, int) or version > FORMAT:
        raise ValueError(
            f"{folder} was saved in format {version}, this version reads up to {FORMAT}: update derender"
        )
    if not complete:
        raise ValueError(f"{folder / CONFIG_FILE} is damaged: copy or train the model again")
    return config


def check_shapes(found: Mapping[str, Tensor], wanted: Mapping[str, Tensor]) -> None:
    """The same names and shapes, or an error that names the first that differs."""
    for name in sorted({*found, *wanted}):
        shapes = [tuple(side[name].shape) if name in side else "nothing" for side in (found, wanted)]
        if shapes[0] != shapes[1]:
            raise ValueError(f"{name}: {shapes[0]} in {WEIGHTS_FILE}, {shapes[1]} by {CONFIG_FILE}")
