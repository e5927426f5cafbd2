"""Pre-training: a `Derenderer` as a task of the training loop, run until its features are there."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Generator, Tensor

from derender.data import ImageSet, split_indices
from derender.model import Derenderer, load
from derender.networks.encoders import Pixels
from derender.networks.factors import GEOMETRY_START
from derender.objectives.perceptual import CALIBRATION_IMAGES, PerceptualFeatures, load_vgg16
from derender.objectives.self_features import load_self_features, train_self_features
from derender.postprocess import Features
from derender.postprocess.whitening import Whitening
from derender.storage.atomic import DamageNoticed
from derender.storage.folder import SplitRecord, write_split
from derender.training.batches import some_of
from derender.training.checkpoint import fit_weights
from derender.training.config import ObjectiveSettings, TrainConfig
from derender.training.distillation import RefineConfig, refine
from derender.training.distributed import ALONE, Ranks, this_rank_writes
from derender.training.features import make_features
from derender.training.held_out_errors import store_errors
from derender.training.loop import MAX_VALIDATION_IMAGES, NOT_RECONSTRUCTION, train_task
from derender.training.process import deterministic_algorithms, locked
from derender.training.run_folder import RunFolder
from derender.training.step import StepResult, own_share, training_step
from derender.training.task import Losses, PhaseProgress, Precision, Progress, TrainingTask, TrainResult
from derender.training.watch import Watcher


def train(
    config: TrainConfig, images: ImageSet, out: str | Path, *, resume: bool = False,
    progress: Callable[[Progress], None] | None = None, accelerator: str = "auto", **how: Any,
) -> TrainResult:  # fmt: skip
    """Train a model on images of its size and estimate its features, in the run folder ``out``.

    Arguments and errors are those of `derender.train`; ``how`` may hold a ``sample_sheet``, which draws a few
    held-out images from time to time.
    """
    report, folder = progress or (lambda _: None), RunFolder(Path(out))
    begins = not (resume and folder.resumable)
    start = config.start_from if begins else folder.model  # a resumed run needs the start no more
    kept = load(start).whitening if config.maps_only and start is not None else None
    task = DerenderTask(config, begins, whitening=kept)
    with locked(folder.path):
        result = train_task(task, images, out, resume=resume, progress=report, accelerator=accelerator, **how)
        if this_rank_writes() and result.stopped != "collapse":
            device = "cuda" if accelerator != "cpu" and torch.cuda.is_available() else "cpu"
            split = split_indices(images.files, config.split, seed=config.seed)
            mapped = isinstance(images.images, np.memmap)
            held_out = images.images[split.validation[:MAX_VALIDATION_IMAGES]]
            some = torch.from_numpy(some_of(images.images, split.train, mapped=mapped))
            phase, trained = Progress.of("features", report), load(folder.model, device=device)
            with deterministic_algorithms(config.deterministic):
                model = make_features(trained, some, config.features, seed=config.seed, progress=phase)
                phase, few = Progress.of("refining", report), torch.from_numpy(held_out)
                lessons = few if len(few) else some[:1], _refine_config(config)
                for _ in range(config.refining.rounds):
                    model = refine(model, some, *lessons, seed=config.seed, progress=phase).model
                model.save(folder.model, overwrite=True)
                write_split(folder.model, SplitRecord(config.split, config.seed))
                store_errors(folder.model, held_out)
    return result


def _refine_config(config: TrainConfig) -> RefineConfig:
    features = config.features.model_dump(exclude={"perturb"})  # refining has wider ranges of its own
    return RefineConfig(**features, refining=config.refining.model_dump(exclude={"rounds"}))


@dataclass(frozen=True)
class DerenderTask(TrainingTask):
    """Train a `Derenderer`, its features kept; ``begins`` is false where a checkpoint gives the weights."""

    config: TrainConfig  # pyrefly: ignore[bad-override]
    begins: bool = True
    ranks: Ranks = ALONE
    whitening: Whitening | None = None
    outside_loss: tuple[str, ...] = NOT_RECONSTRUCTION  # pyrefly: ignore[bad-override]
    replayable: ClassVar[bool] = True

    def shared(self, ranks: Ranks) -> "DerenderTask":
        size, count = self.config.batch_size, ranks.count
        if size % count:
            fix = f"set batch_size={max(size // count, 1) * count}, or start another number of them"
            raise ValueError(f"batch_size {size} cannot be shared evenly by {count} processes: {fix}")
        return replace(self, ranks=ranks)

    def phase(self, done: float) -> float | None:
        own = own_share(self.config.objective, done)
        return own if own in (0.0, 1.0) else None

    def build(self) -> Derenderer:
        """The model as the run begins: untrained, or with the weights of ``start_from``.

        A FileNotFoundError: there is no such model; a ValueError: its weights do not fit, names the first.
        """
        require_perceptual(self.config.objective)
        model, start = Derenderer.seeded(self.config.model, self.config.seed), self.config.start_from
        for factor in model.factors if self.config.maps_only else ():
            net = model.nets[factor.name]
            (net.encoder if factor.mirrored else net).requires_grad_(False)
        if self.config.geometry_start != GEOMETRY_START:
            with torch.no_grad():
                model.nets["geometry"].decoder.last.weight.mul_(self.config.geometry_start / GEOMETRY_START)
        if start is not None and self.begins:
            try:
                weights = {k: v for k, v in model.state_dict().items() if ".growth." in k}
                weights |= load(start).state_dict()
                fit_weights(model, {k: v for k, v in weights.items() if not k.startswith("unet_decoder.")})
            except ValueError as error:
                why = f"{error}; leave its network settings as they are"
                raise ValueError(f"cannot start from {start}: {why}") from error
        return model.with_features(Features(self.whitening))

    def losses(self, model: Derenderer, run: RunFolder, images: Pixels, progress: PhaseProgress) -> Losses:
        """Those of `training_step`; perceptual features are learnt first where the run has none yet."""
        objective, chunks = self.config.objective, self.config.accumulate
        perceptual = perceptual_of(self.config, run, images, progress)

        def step(
            batch: Tensor, generator: Generator, precision: Precision, done: float | None = None, *_: Any
        ) -> StepResult:
            own, ranks = 1.0, ALONE  # held-out images are each judged by one rank
            if done is not None:
                own, ranks = own_share(objective, done), self.ranks
            how = generator, precision, own, ranks, chunks
            return training_step(model, batch, objective, perceptual, *how)

        return step

    def watch(self, memory: dict[str, Any]) -> Watcher:
        """The collapse detector."""
        return Watcher.remembering(self.config.model.ranges, self.config.batch_size, memory, self.ranks)


def require_perceptual(objective: ObjectiveSettings) -> None:
    """Published perceptual features that are missing or damaged are an error."""
    if objective.perceptual == "vgg16":
        load_vgg16(objective.vgg16_path)


def self_features_of(config: Any, file: Path, images: Pixels, progress: PhaseProgress) -> PerceptualFeatures:
    """Self-trained features from a run's file, or learnt from its images, again where it is damaged."""
    if file.exists():
        try:
            return load_self_features(file).to(images.device)
        except ValueError as problem:
            again = f"{problem}: they are learnt again, from the same seed"
            warnings.warn(again, DamageNoticed, stacklevel=2)
    how = {"seed": config.seed, "steps": config.objective.self_features_steps}
    features = train_self_features(images, **how, progress=lambda done, total, _: progress(done, total))
    features.save(file)
    return features


def perceptual_of(
    config: TrainConfig, run: RunFolder, images: Pixels, progress: PhaseProgress
) -> PerceptualFeatures | None:
    """The perceptual features of a run, None without weight; self-trained ones are kept in its folder."""
    objective = config.objective
    if objective.perceptual == "none" or objective.perceptual_weight == 0:
        return None
    if objective.perceptual == "self":
        features = self_features_of(config, run.perceptual, images, progress)
    else:
        features = load_vgg16(objective.vgg16_path).to(images.device)
        if objective.perceptual_rescaled:
            features.calibrate_(images[:CALIBRATION_IMAGES].float() / 255)
    if config.channels_last:
        features = features.to(memory_format=torch.channels_last)  # pyrefly: ignore[no-matching-overload]
    return features
