"""What every trained baseline is: a module that makes features, and a folder that it lies in.

The folder holds `config.json` (which baseline, its settings) and `model.safetensors`, nothing that can run
code; pickles (.pth, .pt, .ckpt) are never opened. Leaves out how each baseline is trained (training.py).
"""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from pydantic import ValidationError
from torch import Tensor, nn

from derender.data import suggestion
from derender.settings import Settings
from derender.storage.atomic import atomic_folder
from derender.storage.tensors import read_tensors, write_tensors
from derender.training.weights import fit_weights

FORMAT = 1
WEIGHTS_FILE, CONFIG_FILE = "model.safetensors", "config.json"
PICKLES = (".pth", ".pt", ".ckpt", ".pkl", ".pickle", ".bin")


class BaselineSettings(Settings):
    """What every baseline's settings have: the side of the pictures it takes, in pixels."""

    image_size: int = 64


class BaselineModel(nn.Module):
    """A network that hands out one or more features for a picture.

    Attributes:
        name: what the command line calls it.
        features: every feature it can hand out; the first is the one it hands out unless told otherwise.
        chosen: those that ``embed`` gives.
    """

    name: ClassVar[str]
    features: ClassVar[tuple[str, ...]]

    def __init__(self, settings: BaselineSettings):
        super().__init__()
        self.settings = settings
        self.chosen = self.features[:1]

    @property
    def image_size(self) -> int:
        """Side of the pictures it takes, in pixels."""
        return self.settings.image_size

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device

    def describe(self, images: Float[Tensor, "n 3 h w"]) -> dict[str, Float[Tensor, "n _"]]:
        """Every feature that was chosen, for pictures in 0..1."""
        raise NotImplementedError

    def embed(self, images: Float[Tensor, "n 3 h w"]) -> dict[str, Float[Tensor, "n _"]]:
        """The chosen features of pictures in 0..1, by name."""
        size = self.image_size
        if tuple(images.shape[1:]) != (3, size, size):
            raise ValueError(
                f"this {self.name} takes pictures of shape (N, 3, {size}, {size}), got "
                f"{tuple(images.shape)}: read them with image_size={size}"
            )
        return self.describe(images)

    def shown(self, images: Float[Tensor, "n 3 h w"]) -> dict[str, Float[Tensor, "n 3 h w"]]:
        """Pictures for a sample sheet, by column: the input and what the network makes of it."""
        return {"input": images}

    def choose(self, names: tuple[str, ...]) -> None:
        """Hand out these features from now on."""
        for name in names:
            if name not in self.features:
                raise ValueError(
                    f"{self.name} has no feature {name!r}{suggestion(name, self.features)}; "
                    f"it has {', '.join(self.features)}"
                )
        if not names:
            raise ValueError(f"name at least one feature; {self.name} has {', '.join(self.features)}")
        self.chosen = tuple(names)

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path:
        """Write settings and weights to ``folder``; complete or not at all."""
        folder = Path(folder)
        if folder.exists() and not overwrite:
            raise FileExistsError(f"{folder} exists already: choose another folder or pass overwrite=True")
        config = {"format": FORMAT, "baseline": self.name, "settings": self.settings.model_dump(mode="json")}
        with atomic_folder(folder) as temporary:
            write_tensors(self.state_dict(), temporary / WEIGHTS_FILE)
            (temporary / CONFIG_FILE).write_text(json.dumps(config, indent=1))
        return folder


Kinds = Mapping[str, tuple[Callable[[Any], BaselineModel], type[BaselineSettings]]]


def saved_baseline(source: str | Path, kinds: Kinds) -> BaselineModel:
    """The baseline that lies in a run folder or a saved folder, in evaluation mode, without gradient.

    Args:
        source: the folder.
        kinds: module and settings of every baseline that may be there, by name.

    Raises:
        FileNotFoundError: nothing is there.
        ValueError: it is a pickle, damaged, of another architecture, or no baseline.
    """
    folder = _folder_of(Path(source))
    config = _config_of(folder)
    name = config["baseline"]
    if name not in kinds:
        raise ValueError(f"{folder} holds the baseline {name!r}, asked for {' or '.join(kinds)}")
    module, kind = kinds[name]
    try:
        settings = kind.model_validate(config["settings"])
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise ValueError(
            f"{folder / CONFIG_FILE}: setting {key!r}: {first['msg']}; train it again"
        ) from error
    model = module(settings)
    try:
        weights = read_tensors(folder / WEIGHTS_FILE)
    except (ValueError, OSError) as error:
        raise ValueError(
            f"{folder / WEIGHTS_FILE} is damaged ({error}): copy or train the model again"
        ) from error
    try:
        fit_weights(model, weights)
    except ValueError as error:
        raise ValueError(f"{folder / WEIGHTS_FILE} is of another architecture: {error}") from error
    return model.eval().requires_grad_(False)


def _folder_of(source: Path) -> Path:
    if source.suffix.lower() in PICKLES:
        raise ValueError(
            f"{source} is a pickle, which can run code when it is read: give a run folder with "
            f"{WEIGHTS_FILE} in it"
        )
    for candidate in (source, source / "model"):
        if (candidate / CONFIG_FILE).is_file() and (candidate / WEIGHTS_FILE).is_file():
            return candidate
    found = sorted(p.name for p in source.iterdir() if p.suffix in PICKLES) if source.is_dir() else []
    if found:
        raise ValueError(
            f"{source} holds {found[0]}, a pickle, which can run code when it is read; it is not opened: "
            f"save the weights as {WEIGHTS_FILE}"
        )
    raise FileNotFoundError(
        f"no baseline at {source} (expected {CONFIG_FILE} and {WEIGHTS_FILE} there or in 'model'): "
        "give a run folder made by 'derender train --model NAME'"
    )


def _config_of(folder: Path) -> dict[str, Any]:
    file = folder / CONFIG_FILE
    try:
        config = json.loads(file.read_text())
        version, whole = config["format"], isinstance(config.get("settings"), dict)
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{file} is damaged: copy or train the model again") from error
    if not isinstance(version, int) or version > FORMAT:
        raise ValueError(
            f"{folder} was saved in format {version}, this version reads up to {FORMAT}: update derender"
        )
    if "baseline" not in config:
        raise ValueError(f"{folder} holds a derender model and no baseline: leave --baseline out")
    if not whole:
        raise ValueError(f"{file} is damaged: copy or train the model again")
    return config
