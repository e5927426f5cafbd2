"""Where the files of a model lie: a folder, one that comes with derender, or one fetched from the Hub."""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from derender.networks.tensor_file import read_tensors
from derender.pretrained import hub
from derender.pretrained.card import CARD_FILE
from derender.pretrained.saved import (
    CONFIG_FILE,
    ERRORS_FILE,
    FITTING_FILE,
    SPLIT_FILE,
    WEIGHTS_FILE,
    WHITENING_FILE,
)

PRETRAINED = Path(__file__).parent


def bundled_models() -> tuple[str, ...]:
    """Names of the trained models that come with derender; each has a card, ``pretrained/NAME/README.md``."""
    return tuple(sorted(folder.parent.name for folder in PRETRAINED.glob(f"*/{CONFIG_FILE}")))


def model_folder(source: str | Path) -> Path:
    """The folder that ``load`` reads for this source.

    Raises:
        FileNotFoundError: nothing is there.
    """
    folder = Path(source)
    for candidate in (folder, folder / "model"):
        if (candidate / CONFIG_FILE).is_file() and (candidate / WEIGHTS_FILE).is_file():
            return candidate
    if folder.exists():
        raise FileNotFoundError(
            f"{folder} holds no model (expected {CONFIG_FILE} and {WEIGHTS_FILE} here or in 'model'): "
            "give a run folder made by 'derender train' or a folder made by model.save"
        )
    if source in bundled_models():
        return PRETRAINED / source
    if isinstance(source, str) and source.count("/") == 1 and not source.startswith((".", "/", "~")):
        weights = (CONFIG_FILE, WEIGHTS_FILE, WHITENING_FILE, FITTING_FILE)
        return hub.download(source, (*weights, ERRORS_FILE, SPLIT_FILE, CARD_FILE))
    raise FileNotFoundError(
        f"no model at {source}: give a run folder, a saved folder, a Hub id 'owner/name', or one of those "
        f"that come with derender ({', '.join(bundled_models())})"
    )


def texts_beside(folder: Path | None, tensors: Mapping[str, Tensor]) -> dict[str, str]:
    """Card, held-out errors and split of a saved folder, by file, if its files hold these tensors."""
    if folder is None or not (folder / WEIGHTS_FILE).is_file():
        return {}
    stored: dict[str, Tensor] = {}
    for name in (WEIGHTS_FILE, WHITENING_FILE, FITTING_FILE):
        stored |= read_tensors(folder / name) if (folder / name).is_file() else {}
    if stored.keys() != tensors.keys() or any(
        not torch.equal(stored[name].to(value), value) for name, value in tensors.items()
    ):
        return {}
    files = (folder / name for name in (CARD_FILE, ERRORS_FILE, SPLIT_FILE))
    return {file.name: file.read_text(encoding="utf-8") for file in files if file.is_file()}
