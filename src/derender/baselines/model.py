"""The base of every baseline with a network: its features, its losses in training, and its saved folder.

The folder holds `config.json` (which baseline, its settings) and `model.safetensors`, nothing that can run
code; pickles (.pth, .pt, .ckpt) are never opened. Leaves out the training itself (training.py).
"""

import importlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import torch
from jaxtyping import Float, UInt8
from pydantic import ValidationError
from torch import Generator, Tensor, nn

from derender.baselines.registry import network_type
from derender.data import suggestion
from derender.settings import Settings
from derender.storage.atomic import atomic_folder
from derender.storage.tensors import read_tensors, write_tensors
from derender.training.checkpoint import fit_weights
from derender.training.task import Precision

FORMAT = 1
WEIGHTS_FILE, CONFIG_FILE = "model.safetensors", "config.json"
Images = Float[Tensor, "n 3 h w"]
"""Images, in 0..1 where nothing else is said."""
PICKLES = (".pth", ".pt", ".ckpt", ".pkl", ".pickle", ".bin")


def optional(package: str, needed_for: str) -> ModuleType:
    """A package that only some baselines need; ValueError with the extra to install where it is missing."""
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise ValueError(
            f"{needed_for} needs the package {package.split('.')[0]}, which is not here ({error}): "
            "pip install 'derender[baselines]'"
        ) from error


@dataclass(frozen=True)
class LossInputs:
    """Everything that losses depend on besides network and images.

    Attributes:
        config: settings of the run.
        generator: of all randomness.
        precision: makes the context in which the network computes.
        aid: the result of ``BaselineModel.prepare``.
    """

    config: Any
    generator: Generator
    precision: Precision
    aid: Any = None


class BaselineSettings(Settings):
    """The settings that every baseline has: the side of its input images, in pixels."""

    image_size: int = 64


class BaselineModel(nn.Module):
    """A network that computes one or more features of an image.

    Attributes:
        name: its row in the registry.
        features: every feature it can compute; the first is the default.
        settings_type: of the network, as its saved folder has them.
        config_type: settings of a training run; its ``model`` is what ``build`` starts from.
        not_judged: names of losses that say nothing about held-out images.
        chosen: the features that ``embed`` returns.
    """

    name: ClassVar[str]
    features: ClassVar[tuple[str, ...]]
    settings_type: ClassVar[type[BaselineSettings]]
    config_type: ClassVar[type[Settings]]
    not_judged: ClassVar[tuple[str, ...]] = ()

    def __init__(self, settings: BaselineSettings):
        super().__init__()
        self.settings = settings
        self.chosen = self.features[:1]

    @classmethod
    def build(cls, config: Any) -> "BaselineModel":
        """The untrained network of a run; an error if the configuration names something that is missing."""
        return cls(config.model)

    @staticmethod
    def prepare(
        config: Any, images: UInt8[Tensor, "n 3 h w"], file: Path, progress: Callable[[int, int], None]
    ) -> Any:
        """The ``aid`` that the losses need besides the network, from the training images; None if nothing.

        ``file`` keeps it for a resumed run.
        """
        return None

    def losses(self, images: Images, run: LossInputs) -> dict[str, Tensor]:
        """Losses and other numbers of a batch in 0..1, by name (training.OUTSIDE_LOSS names the others)."""
        raise NotImplementedError

    @property
    def image_size(self) -> int:
        """Side of the input images, in pixels."""
        return self.settings.image_size

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device

    def describe(self, images: Images) -> dict[str, Float[Tensor, "n _"]]:
        """Every feature of images in 0..1, by name."""
        raise NotImplementedError

    def embed(self, images: Images) -> dict[str, Float[Tensor, "n _"]]:
        """The chosen features of images in 0..1, by name."""
        size = self.image_size
        if tuple(images.shape[1:]) != (3, size, size):
            raise ValueError(
                f"this {self.name} takes images of shape (N, 3, {size}, {size}), got "
                f"{tuple(images.shape)}: read them with image_size={size}"
            )
        every = self.describe(images)
        return {name: every[name] for name in self.chosen}

    def shown(self, images: Images, config: Any) -> dict[str, Images]:
        """Images for a sample sheet of a run, by column: the input and the network's output."""
        return {"input": images}

    def choose(self, names: tuple[str, ...]) -> None:
        """Make ``embed`` return these features from now on."""
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


def load_baseline(source: str | Path, name: str | None = None) -> BaselineModel:
    """The baseline saved in a run folder or a model folder, in evaluation mode, without gradient.

    Args:
        source: the folder.
        name: which baseline it has to be; None accepts any.

    Raises:
        FileNotFoundError: there is no such folder.
        ValueError: it is a pickle, damaged, of another architecture, another baseline, or none.
    """
    folder = _folder_of(Path(source))
    config = _config_of(folder)
    stored, file = str(config["baseline"]), folder / WEIGHTS_FILE
    if name not in (None, stored):
        raise ValueError(f"{folder} holds the baseline {stored!r}, asked for {name}")
    kind = network_type(stored)
    try:
        model = kind(kind.settings_type.model_validate(config["settings"]))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise ValueError(
            f"{folder / CONFIG_FILE}: setting {key!r}: {first['msg']}; train it again"
        ) from error
    try:
        weights = read_tensors(file)
    except (ValueError, OSError) as error:
        raise ValueError(f"{file} is damaged ({error}): copy or train the model again") from error
    try:
        fit_weights(model, weights)
    except ValueError as error:
        raise ValueError(f"{file} is of another architecture: {error}") from error
    return model.eval().requires_grad_(False)


def open_run(name: str, source: str | Path | None, image_size: int = 0, seed: int = 0) -> Any:
    """A saved baseline of that name; see `registry.open_baseline`."""
    if source is None:
        raise ValueError(f"the baseline {name} needs a model: its run folder")
    return load_baseline(source, name)


def _folder_of(source: Path) -> Path:
    if source.suffix.lower() in PICKLES:
        raise ValueError(
            f"{source} is a pickle, which can run code when it is read: give a run folder with "
            f"{WEIGHTS_FILE} in it"
        )
    for candidate in (source, source / "model"):
        if (candidate / CONFIG_FILE).is_file() and (candidate / WEIGHTS_FILE).is_file():
            return candidate
    pickles = sorted(p.name for p in source.iterdir() if p.suffix in PICKLES) if source.is_dir() else []
    if pickles:
        raise ValueError(
            f"{source} holds {pickles[0]}, a pickle, which can run code when it is read; it is not opened: "
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
        version, complete = config["format"], isinstance(config.get("settings"), dict)
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{file} is damaged: copy or train the model again") from error
    if not isinstance(version, int) or version > FORMAT:
        raise ValueError(
            f"{folder} was saved in format {version}, this version reads up to {FORMAT}: update derender"
        )
    if "baseline" not in config:
        raise ValueError(f"{folder} holds a derender model and no baseline: leave the baseline's name out")
    if not complete:
        raise ValueError(f"{file} is damaged: copy or train the model again")
    return config
