"""The base of every baseline with a network: its features, its losses, its saved folder and its training run.

A saved folder holds `config.json` (which baseline, its settings) and `model.safetensors`, nothing that can
run code; pickles are never opened. Checkpoints, exact resume, early stop and reports are those of our own
model (training/loop.py).
"""

import json
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import torch
from jaxtyping import Float, UInt8
from torch import Generator, Tensor, nn

from derender.baselines import network_type
from derender.data import ImageSet, check_images, split_indices
from derender.settings import Settings
from derender.storage import folder as saved
from derender.storage.atomic import new_folder
from derender.storage.places import CONFIG_FILE, WEIGHTS_FILE, require_known
from derender.storage.tensors import write_tensors
from derender.training import config as configs
from derender.training import run_folder
from derender.training import task as loop
from derender.training.derender_task import self_features_of
from derender.training.loop import train_task

PICKLES = (".pth", ".pt", ".ckpt", ".pkl", ".pickle", ".bin")
OUTSIDE_LOSS = ("l1", "codes_used", "active", "found")  # numbers that ``losses`` returns beside the losses
Images = Float[Tensor, "n 3 h w"]  # in 0..1 unless stated
Features = dict[str, Float[Tensor, "n _"]]


class BaselineSettings(Settings):
    """The settings that every baseline has: the side of its input images, in pixels."""

    image_size: int = 64


class BaselineConfig(configs.LoopSettings):
    """Settings of a training run in the common loop."""

    optimiser: configs.OptimiserSettings = configs.OptimiserSettings(learning_rate=1e-3, weight_decay=0.0)


class BaselineModel(nn.Module, ABC):
    """A network that computes ``features`` of an image, of which ``embed`` returns the ``chosen``.

    The first is the default. ``settings_type`` is of the network, ``config_type`` of a training run;
    ``given_as`` says how another baseline is given it.
    """

    name: ClassVar[str]
    features: ClassVar[tuple[str, ...]]
    settings_type: ClassVar[type[BaselineSettings]]
    config_type: ClassVar[type[Settings]]
    given_as: ClassVar[str] = ""
    image_size: int  # side of the input images, in pixels

    def __init__(self, settings: BaselineSettings):
        super().__init__()
        self.settings, self.chosen, self.image_size = settings, self.features[:1], settings.image_size

    @classmethod
    def open(cls, source: str | Path | None, *, image_size: int | None = None, seed: int = 0) -> Any:
        """A trained one; see `open_baseline`."""
        if source is None:
            made = f"a run of derender train --model {cls.name}{cls.given_as}"
            raise ValueError(f"the baseline {cls.name} needs a model: {made}")
        return load_baseline(source, cls.name)

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device

    @abstractmethod
    def describe(self, images: Images) -> Features:
        """Every feature of images in 0..1, by name."""

    def embed(self, images: Images) -> Features:
        """The chosen features of images in 0..1, by name."""
        check_images(images, self.image_size)
        every = self.describe(images)
        return {name: every[name] for name in self.chosen}

    def choose(self, names: tuple[str, ...]) -> None:
        """Make ``embed`` return these features from now on."""
        for name in names or ("",):
            require_known(f"feature of {self.name}", name, self.features)
        self.chosen = tuple(names)

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path:
        """Write settings and weights to ``folder``; complete or not at all."""
        settings = self.settings.model_dump(mode="json")
        config = {"format": saved.FORMAT, "baseline": self.name, "settings": settings}
        with new_folder(folder, overwrite=overwrite) as temporary:
            write_tensors(self.state_dict(), temporary / WEIGHTS_FILE)
            (temporary / CONFIG_FILE).write_text(json.dumps(config, indent=1))
        return Path(folder)


def load_baseline(source: str | Path, name: str | None = None) -> BaselineModel:
    """The baseline saved in a run folder or a model folder, in evaluation mode, without gradient.

    ``name`` says which baseline it has to be; None accepts any. A FileNotFoundError: there is no such folder;
    a ValueError: it is a pickle, damaged, another baseline, or none.
    """
    folder = _folder_of(Path(source))
    config = saved.saved_config(folder)
    if "baseline" not in config:
        raise ValueError(f"{folder} holds a derender model and no baseline: leave the baseline's name out")
    stored = str(config["baseline"])
    if name not in (None, stored):
        raise ValueError(f"{folder} holds the baseline {stored!r}, asked for {name}")
    kind = network_type(stored)
    with saved.naming_damage(folder):
        settings = kind.settings_type.model_validate(config["settings"])
    with torch.device("meta"):
        kind(settings)  # a package that is missing is an error of its own
    with saved.naming_damage(folder):
        model: BaselineModel = saved.read_weights(folder, lambda: kind(settings))
    return model.eval().requires_grad_(False)


def _folder_of(source: Path) -> Path:
    for candidate in (source, source / "model"):
        if all((candidate / file).is_file() for file in (CONFIG_FILE, WEIGHTS_FILE)):
            return candidate
    for file in (source, *(sorted(source.iterdir()) if source.is_dir() else ())):
        if file.suffix.lower() in PICKLES:
            refused = "is a pickle, which can run code when it is read, and is not opened"
            raise ValueError(f"{file} {refused}: give a run folder with {WEIGHTS_FILE} in it")
    missing = f"expected {CONFIG_FILE} and {WEIGHTS_FILE} there or in 'model'"
    fix = "give a run folder made by 'derender train --model NAME'"
    raise FileNotFoundError(f"no baseline at {source} ({missing}): {fix}")


@dataclass(frozen=True)
class LossInputs:
    """What losses depend on besides network and images; ``aid`` is the result of ``LoopModel.prepare``."""

    config: Any
    generator: Generator
    precision: loop.Precision
    aid: Any = None


class LoopModel(BaselineModel):
    """A baseline that learns in the common training loop; its configuration's ``model`` has the sizes.

    ``not_judged`` names losses that say nothing about held-out images.
    """

    not_judged: ClassVar[tuple[str, ...]] = ()
    reconstruct: Callable[[Images], Images]
    """Images in 0..1 through the network; only of networks that make images again."""

    @classmethod
    def build(cls, config: Any) -> "LoopModel":
        """The untrained network of a run; an error if the configuration names something that is missing."""
        return cls(config.model)

    @staticmethod
    def prepare(config: Any, device: torch.device, perceptual: Callable[[], Any]) -> Any:
        """What the losses need besides the network; ``perceptual`` gives features learnt from the images."""
        return None

    @abstractmethod
    def losses(self, images: Images, run: LossInputs) -> dict[str, Tensor]:
        """Losses and other numbers (OUTSIDE_LOSS) of a batch in 0..1, by name."""

    def shown(self, images: Images) -> dict[str, Images]:
        """Images for a sample sheet of a run, by column: the input and the network's output."""
        return {"input": images, "reconstruction": self.reconstruct(images)}

    @classmethod
    def train_into(cls, config: Any, images: ImageSet, out: str | Path, **how: Any) -> loop.TrainResult:
        """Train in the common loop; see `train_baseline`."""
        task = BaselineTask(config, (*OUTSIDE_LOSS, *cls.not_judged))
        return train_task(task, images, out, **how)


@dataclass(frozen=True)
class BaselineTask(loop.TrainingTask):
    """Train a baseline as its configuration says."""

    config: Any  # pyrefly: ignore[bad-override]
    outside_loss: tuple[str, ...]  # pyrefly: ignore[bad-override]

    def build(self) -> LoopModel:
        """The untrained network; torch's global generator is left as it was."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.config.seed)
            return network_type(self.config.baseline).build(self.config)

    def losses(
        self, model: LoopModel, run: run_folder.RunFolder, images: UInt8[Tensor, "n 3 h w"],
        progress: loop.PhaseProgress,
    ) -> loop.Losses:  # fmt: skip
        learnt = partial(self_features_of, self.config, run.perceptual, images, progress)
        aid = model.prepare(self.config, images.device, learnt)

        def step(batch: Tensor, generator: Generator, precision: loop.Precision, *_: Any) -> loop.StepLosses:
            terms = model.losses(batch, LossInputs(self.config, generator, precision, aid))
            total = torch.stack([term for name, term in terms.items() if name not in OUTSIDE_LOSS]).sum()
            return loop.StepLosses(total, {name: term.detach() for name, term in terms.items()})

        return step


class ShortRun:
    """A run folder filled in one go of minutes, without checkpoints; arguments as for `train_baseline`."""

    def __init__(
        self, config: Any, images: ImageSet, out: str | Path, *, resume: bool = False,
        progress: Callable[[loop.Progress], None] | None = None, accelerator: str = "cpu",
    ):  # fmt: skip
        if resume:
            why = "trains in minutes and is not resumed"
            raise ValueError(f"{config.baseline} {why}: train it again into another folder")
        self.config, self.split = config, split_indices(images.files, config.split, seed=config.seed)
        data = run_folder.describe_data(images, self.split)
        self.folder = run_folder.start_run(Path(out), config, data, accelerator)
        self.report, self.began = progress or (lambda _: None), time.perf_counter()

    @property
    def seconds(self) -> float:
        """Time since the start."""
        return time.perf_counter() - self.began

    def note(self, done: int, total: int, terms: dict[str, float] | None = None) -> None:
        """Report progress, in images."""
        self.report(loop.Progress("train", done, total, done / self.seconds, terms))

    def record(self, kind: str, images: int, numbers: dict[str, float]) -> None:
        """A line of metrics.jsonl."""
        row = {"kind": kind, "images": images, "seconds": round(self.seconds, 2), **numbers}
        run_folder.append_metrics(self.folder, row)

    def finish(self, model: BaselineModel, images: int, numbers: dict[str, float]) -> loop.TrainResult:
        """Save the model; ``numbers`` are the last scores by name."""
        seconds = self.seconds
        model.save(self.folder.model)
        saved.write_split(self.folder.model, saved.SplitRecord(self.config.split, self.config.seed))
        return loop.TrainResult(self.folder.path, images, seconds, images / seconds, numbers, "images", ())


def baseline_config(name: str, overrides: Sequence[str] = ()) -> Settings:
    """The settings of a baseline's run, with ``key=value`` changes."""
    return configs.with_changes(network_type(name).config_type(), overrides)


def read_any_config(path: Path) -> Any:
    """The configuration of a run: of our model, a fine-tuning, or a baseline."""
    tree = run_folder.read_config_tree(path)
    name, ours = tree.get("baseline"), configs.FinetuneConfig if "target" in tree else configs.TrainConfig
    return run_folder.read_config(path, ours if name is None else network_type(str(name)).config_type)


def stored_config(run: Path, name: str) -> Any:
    """The settings of a run to resume, which has to be of ``name`` ("derender": of any)."""
    config = read_any_config(run)
    if isinstance(config, configs.FinetuneConfig):
        raise ValueError(f"{run} was made by derender finetune: continue with derender finetune --resume")
    trained = getattr(config, "baseline", "derender")
    if name not in ("derender", trained):
        raise ValueError(f"{run} trained {trained}, not {name}: give model {trained} or another folder")
    return config


def image_size_of(config: Any) -> int:
    """Side of the images that a run takes, in pixels."""
    model = getattr(config, "model", config)
    return getattr(model, "network", model).image_size
