"""Training runs of baselines: settings by name, the task that joins a baseline to the loop, short runs.

Runs, checkpoints, exact resume, early stop and reports are those of our own model (training/loop.py).
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import UInt8
from torch import Generator, Tensor, nn

from derender.baselines.model import BaselineModel, Images, LossInputs
from derender.baselines.registry import config_type, network_type
from derender.data import ImageSet, Split, split_indices
from derender.settings import Settings
from derender.training.config import FinetuneConfig, TrainConfig, with_changes
from derender.training.loop import train_task
from derender.training.run_folder import (
    RunFolder,
    append_metrics,
    describe_data,
    read_config,
    read_config_tree,
    start_run,
)
from derender.training.task import (
    Held,
    PhaseProgress,
    Precision,
    Progress,
    StepLosses,
    TrainingTask,
    TrainResult,
)
from derender.training.watch import FiniteWatch

OUTSIDE_LOSS = ("l1", "codes_used", "active", "found")
"""Numbers that ``losses`` returns beside the losses."""
SheetOf = Callable[[Callable[[Any, Tensor], dict[str, Tensor]]], Any]
"""Makes the loop's drawing function from one that gives images by column."""


def baseline_config(name: str, overrides: Sequence[str] = ()) -> Settings:
    """The settings of a baseline's run, with ``key=value`` changes."""
    return with_changes(config_type(name)(), overrides)


def read_any_config(path: Path) -> Any:
    """The configuration of a run: of our model, a fine-tuning, or a baseline."""
    tree = read_config_tree(path)
    name, ours = tree.get("baseline"), FinetuneConfig if "target" in tree else TrainConfig
    return read_config(path, ours if name is None else config_type(str(name)))


def stored_config(run: Path, name: str) -> Any:
    """The settings of a run to go on with, which has to be of ``name`` ("derender": of any)."""
    config = read_any_config(run)
    if isinstance(config, FinetuneConfig):
        raise ValueError(f"{run} was made by derender finetune: go on with derender finetune --resume")
    trained = getattr(config, "baseline", "derender")
    if name not in ("derender", trained):
        raise ValueError(f"{run} trained {trained}, not {name}: give model {trained} or another folder")
    return config


def image_size_of(config: Any) -> int:
    """Side of the images that a run takes, in pixels."""
    model = getattr(config, "model", config)
    return getattr(model, "network", model).image_size


def train_in_loop(
    config: Any, images: ImageSet, out: str | Path, *, sample_sheet: SheetOf | None = None, **how: Any
) -> TrainResult:
    """Train a baseline in the common loop; see `registry.train_baseline`."""
    task = BaselineTask(config)
    sheet = None if sample_sheet is None else sample_sheet(task.shown)
    return train_task(task, images, out, sample_sheet=sheet, **how)


@dataclass(frozen=True)
class BaselineTask(TrainingTask):
    """Train a baseline as its configuration says."""

    config: Any

    @property
    def network(self) -> type[BaselineModel]:
        return network_type(self.config.baseline)

    @property
    def outside_loss(self) -> tuple[str, ...]:
        """Names of numbers by which held-out images are not judged."""
        return (*OUTSIDE_LOSS, *self.network.not_judged)

    def check(self) -> None:
        """A missing package or model is an error before a folder is made."""
        self.build()

    def build(self) -> BaselineModel:
        """The untrained network; torch's global generator is left as it was."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.config.seed)
            return self.network.build(self.config)

    def step_module(
        self, model: nn.Module, run: RunFolder, images: UInt8[Tensor, "n 3 h w"], progress: PhaseProgress
    ) -> "BaselineStep":
        aid = self.network.prepare(self.config, images, run.perceptual, progress)
        return BaselineStep(model, self.config, aid)

    def watch(self, memory: dict[str, Any]) -> FiniteWatch:
        """Stops a run whose loss is NaN or infinite."""
        return FiniteWatch()

    def shown(self, model: BaselineModel, images: Images) -> dict[str, Tensor]:
        """Images for a sample sheet, by column."""
        return model.shown(images, self.config)


class BaselineStep(nn.Module):
    """A baseline and its losses; a batch goes in, the total and the result come out."""

    def __init__(self, model: nn.Module, config: Any, aid: Any):
        super().__init__()
        self.model, self.config = model, config
        self.aid = [aid]  # in a list: its weights are not this module's

    def forward(
        self,
        images: Tensor,
        generator: Generator,
        precision: Precision,
        done: float | None = None,
        rows: Tensor | None = None,
    ) -> tuple[Tensor, Held]:
        assert isinstance(self.model, BaselineModel)
        terms = self.model.losses(images, LossInputs(self.config, generator, precision, self.aid[0]))
        total = torch.stack([term for name, term in terms.items() if name not in OUTSIDE_LOSS]).sum()
        return total, Held(StepLosses(total, {name: term.detach() for name, term in terms.items()}))


class ShortRun:
    """A run folder filled in one go of minutes, without checkpoints: resnet18 and ris.

    Args:
        config: settings with ``split``, ``seed`` and ``baseline``.
        images: all images, of which ``split`` learns from a part.
        out: a new folder.
        resume: refused.
        progress: called with the share done.
        accelerator: "cpu" or "cuda".
    """

    def __init__(
        self,
        config: Any,
        images: ImageSet,
        out: str | Path,
        *,
        resume: bool = False,
        progress: Callable[[Progress], None] | None = None,
        accelerator: str = "cpu",
    ):
        if resume:
            raise ValueError(
                f"{config.baseline} trains in minutes and is not resumed: train it again into another folder"
            )
        self.split: Split = split_indices(images.files, config.split, seed=config.seed)
        self.folder = start_run(Path(out), config, describe_data(images, self.split), accelerator)
        self.report, self.accelerator = progress or (lambda _: None), accelerator
        self.began = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Time since the start."""
        return time.perf_counter() - self.began

    def note(self, done: int, total: int, terms: dict[str, float] | None = None) -> None:
        """Report progress, in images."""
        self.report(Progress("train", done, total, done / self.seconds, terms))

    def record(self, kind: str, images: int, numbers: dict[str, float]) -> None:
        """A line of metrics.jsonl."""
        append_metrics(
            self.folder, {"kind": kind, "images": images, "seconds": round(self.seconds, 2), **numbers}
        )

    def finish(self, model: BaselineModel, images: int, numbers: dict[str, float]) -> TrainResult:
        """Save the model; ``numbers`` are the last scores by name."""
        seconds = self.seconds
        model.save(self.folder.model)
        return TrainResult(self.folder.path, images, seconds, images / seconds, numbers, "images", ())
