"""The training loop: one process or many (Lightning Fabric), resumable to the same weights.

Everything random is a function of the seed and the number of pictures seen, so the loop needs nothing but
weights, optimiser and counters to go on where it stopped.
"""

import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import partial
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor, nn
from torch.utils.tensorboard.writer import SummaryWriter

from derender.data import PictureSet, split_indices
from derender.storage.atomic import atomic_file
from derender.training.allocator import freed_memory_kept
from derender.training.batches import Batches, Reader, batches_of, random_stream, some_of
from derender.training.checkpoint import TrainState, resume_from, save_checkpoint
from derender.training.complete import complete_model
from derender.training.config import TrainConfig
from derender.training.derender_task import DerenderTask, sharing_batches
from derender.training.determinism import deterministic_algorithms
from derender.training.distributed import Ranks, first_then_others, open_fabric, ranks_of, this_rank_writes
from derender.training.fabric import Fabric
from derender.training.finite import broken_gradient, not_finite
from derender.training.interrupt import TrainingInterrupted, stop_on_signal
from derender.training.kept_model import KeptModel
from derender.training.progress import Progress, TrainResult
from derender.training.run_folder import (
    RunFolder,
    append_metrics,
    describe_data,
    drop_metrics_after,
    reopen_run,
    start_run,
)
from derender.training.schedule import kept, learning_rate, passed
from derender.training.step import Precision
from derender.training.step_module import compute_step
from derender.training.task import StepLosses, Task, Watch
from derender.training.validate import validate
from derender.training.watch import Finding

SAMPLE_COUNT = 8
LOG_EVERY_STEPS = 50
MAX_VALIDATION_PICTURES = 1_000

SampleSheet = Callable[[Any, Tensor], Image.Image]
"""Draws what a model makes of a few pictures."""


def train(
    config: TrainConfig,
    pictures: PictureSet,
    out: str | Path,
    *,
    resume: bool = False,
    sample_sheet: SampleSheet | None = None,
    progress: Callable[[Progress], None] | None = None,
    accelerator: str = "auto",
) -> TrainResult:
    """Train our model on pictures; everything it makes lies in the folder ``out``.

    Args:
        config: see `derender.training.config.resolve`.
        pictures: at the model's image size.
        out: a new folder, or with ``resume`` the folder of an unfinished run.
        sample_sheet: draws a sheet for a few held-out pictures from time to time.
        progress: called after every step.
        accelerator: "auto", "cpu" or "cuda".

    Raises:
        FileExistsError: ``out`` is not empty and ``resume`` was not asked for.
        ValueError: pictures and configuration do not fit, or the run to resume has other settings.
        TrainingInterrupted: Ctrl-C or SIGTERM; the run can be resumed.
    """
    begins = not (resume and RunFolder(Path(out)).resumable)
    result = train_task(
        DerenderTask(config, begins),
        pictures,
        out,
        resume=resume,
        sample_sheet=sample_sheet,
        progress=progress,
        accelerator=accelerator,
    )
    if this_rank_writes() and result.stopped != "collapse":
        split = split_indices(pictures.files, config.split, seed=config.seed)
        on_gpu = accelerator != "cpu" and torch.cuda.is_available()
        with deterministic_algorithms(config.deterministic):
            complete_model(
                RunFolder(result.folder).model,
                config,
                some_of(pictures.images, split.train),
                np.ascontiguousarray(pictures.images[split.validation[:MAX_VALIDATION_PICTURES]]),
                device="cuda" if on_gpu else "cpu",
                progress=lambda done, total: (progress or (lambda _: None))(
                    Progress("features", done, total)
                ),
            )
    return result


def train_task(
    task: Task,
    pictures: PictureSet,
    out: str | Path,
    *,
    resume: bool = False,
    sample_sheet: SampleSheet | None = None,
    progress: Callable[[Progress], None] | None = None,
    accelerator: str = "auto",
) -> TrainResult:
    """Train whatever the task says, as ``train`` does with our model."""
    with deterministic_algorithms(task.config.deterministic):
        return _train(
            task, pictures, Path(out), resume, sample_sheet, progress or (lambda _: None), accelerator
        )


def _train(
    task: Task,
    pictures: PictureSet,
    out: Path,
    resume: bool,
    sample_sheet: SampleSheet | None,
    report: Callable[[Progress], None],
    accelerator: str,
) -> TrainResult:
    config = task.config
    pictures.require(10)
    fabric = open_fabric(accelerator, all_learn=isinstance(task, DerenderTask) and task.all_learn)
    ranks = ranks_of(fabric)
    task = sharing_batches(task, ranks)
    split = split_indices(pictures.files, config.split, seed=config.seed)
    held_out = torch.from_numpy(
        np.ascontiguousarray(pictures.images[split.validation[:MAX_VALIDATION_PICTURES]])
    )
    batches = batches_of(pictures.images, split.train, config, fabric.device)

    task.check()
    if not ranks.first:
        run = RunFolder(out)
    elif resume:
        run = reopen_run(out, config)
    else:
        device = f"{ranks.count} x {fabric.device.type}" if ranks.count > 1 else str(fabric.device)
        run = start_run(out, config, describe_data(pictures, split), device)
    model = task.build().to(fabric.device)
    if config.channels_last:
        model = model.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    with first_then_others(fabric):
        step = task.step_module(
            model, run, batches.sample(), lambda done, total: report(Progress("perceptual", done, total))
        )
    settings = config.optimiser
    optimiser = torch.optim.Adam(
        model.parameters(),
        lr=settings.learning_rate,
        betas=settings.betas,
        weight_decay=settings.weight_decay,
        fused=True,
    )
    module, wrapped = fabric.setup(step, optimiser)
    state, note = TrainState(), None
    if resume:
        state, note = resume_from(run.last, run.previous, model, optimiser)
    for group in optimiser.param_groups:
        group.update(betas=settings.betas, weight_decay=settings.weight_decay)
    if ranks.first:
        drop_metrics_after(run, state.images)
        if note is not None:
            append_metrics(run, {"kind": "note", "images": state.images, "text": note})
    watcher = task.watch(state.watcher) if config.watch else None
    memory = freed_memory_kept() if fabric.device.type == "cpu" else nullcontext()
    with memory:
        return _go_on(
            _Run(
                task,
                run,
                fabric,
                ranks,
                module,
                wrapped,
                batches,
                fabric.to_device(held_out),
                watcher,
                sample_sheet,
                state,
                fell_back=note is not None,
            ),
            report,
        )


@dataclass
class _Run:
    """A run in progress: everything that lasts from one step to the next."""

    task: Task
    folder: RunFolder
    fabric: Fabric
    ranks: Ranks
    module: nn.Module
    optimiser: torch.optim.Optimizer
    batches: Batches
    held_out: Tensor
    watcher: Watch | None
    sample_sheet: SampleSheet | None
    state: TrainState
    validation: dict[str, float] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    fell_back: bool = False  # the last checkpoint is damaged: it is not to become the previous one

    def __post_init__(self) -> None:
        self.config = self.task.config
        self.precision = network_precision(self.config.precision, self.fabric.device)
        self.reader = Reader(self.batches, self.ranks)
        self.kept = KeptModel(self.folder, self.model, self.config.keep)
        self.writer = None
        if self.ranks.first:
            self.writer = SummaryWriter(str(self.folder.path / "tensorboard"), purge_step=self.state.images)

    @property
    def model(self) -> nn.Module:
        return self.module.model  # type: ignore[return-value]

    def close(self) -> None:
        """Finish what is being written."""
        self.reader.close()
        if self.writer is not None:
            self.writer.close()

    def step(self) -> StepLosses:
        """One batch: losses, gradients, update, watcher."""
        config, state = self.config, self.state
        position = state.images // config.batch_size
        rate = learning_rate(config.optimiser, state.images, config.images)
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        noise = random_stream(config.seed, "perturb", position)
        result = compute_step(
            self.module,
            self.reader.at(position),
            noise,
            self.precision,
            state.images / config.images,
        )
        self.fabric.backward(result.total)
        broken = broken_gradient(self.model)
        if broken is None:
            self.optimiser.step()
        self.optimiser.zero_grad(set_to_none=True)
        state.images += config.batch_size
        if self.watcher is not None:
            self.findings = self.watcher.look(state.images, result)
        if broken is not None and not any(finding.fatal for finding in self.findings):
            self.findings = (*self.findings, not_finite(broken))
        return result

    def validate(self) -> None:
        """Score held-out pictures; keep the weights if they are the best so far."""
        if not len(self.held_out):
            return
        self.validation = validate(
            self.module, self.held_out, self.config, self.precision, self.task.outside_loss, self.ranks
        )
        loss, best = self.validation["loss"], self.state.best_loss
        self.log("validation", self.validation)
        if not isfinite(loss):
            self.findings = (*self.findings, not_finite("the loss of held-out pictures"))
            return
        if best is not None and not loss < best:
            self.state.validations_since_best += 1
            return
        self.state.best_loss, self.state.validations_since_best = loss, 0
        if self.ranks.first:
            save_checkpoint(self.folder.best, self.model, self.optimiser, self.state)
            self.kept.at_best(self.state.images)

    def draw(self) -> None:
        """Write a sheet of held-out pictures taken apart."""
        if self.sample_sheet is None or not len(self.held_out) or not self.ranks.first:
            return
        self.model.eval()
        with torch.no_grad():
            sheet = self.sample_sheet(self.model, self.held_out[:SAMPLE_COUNT].float() / 255)
        self.model.train()
        with atomic_file(self.folder.samples / f"{self.state.images:09d}.png") as temporary:
            sheet.save(temporary, format="PNG")

    def checkpoint(self) -> None:
        """Keep everything a resumed run needs."""
        if not self.ranks.first:
            return
        self.state.watcher = self.watcher.memory() if self.watcher is not None else {}
        previous = None if self.fell_back else self.folder.previous
        save_checkpoint(self.folder.last, self.model, self.optimiser, self.state, previous=previous)
        self.fell_back = False
        self.kept.at_checkpoint(self.state.images)

    def log(self, kind: str, values: dict[str, Any]) -> None:
        state = self.state
        if self.writer is None:
            return
        append_metrics(
            self.folder, {"kind": kind, "images": state.images, "seconds": round(state.seconds, 2), **values}
        )
        for name, value in values.items():
            if isinstance(value, float):
                self.writer.add_scalar(f"{kind}/{name}", value, state.images)

    def why_stop(self) -> str | None:
        """What ends the run now, if anything."""
        config, state = self.config, self.state
        if any(finding.fatal for finding in self.findings):
            return "collapse"
        if state.images >= config.images:
            return "images"
        if config.minutes is not None and state.seconds >= 60 * config.minutes:
            return "minutes"
        if state.validations_since_best >= config.patience:
            return "patience"
        return None


def _go_on(run: _Run, report: Callable[[Progress], None]) -> TrainResult:
    """Train from where the run stands until something ends it."""
    config, state = run.config, run.state
    began, images_before, seconds_before = time.perf_counter(), state.images, state.seconds
    stopped, steps = run.why_stop(), 0
    with stop_on_signal() as signal_request:
        while stopped is None:
            before = state.images
            result = run.step()
            steps += 1
            elapsed = time.perf_counter() - began
            state.seconds, speed = seconds_before + elapsed, (state.images - images_before) / elapsed
            waiting = run.reader.waited_s / elapsed
            terms = None
            if steps % LOG_EVERY_STEPS == 1:
                terms = run.ranks.mean({name: value.item() for name, value in result.terms.items()})
                run.log("train", {**terms, "images_per_second": speed, "waiting": waiting})
            report(Progress("train", state.images, config.images, speed, terms, waiting))

            elapsed, stop_asked = run.ranks.largest(elapsed, signal_request.asked)
            state.seconds = seconds_before + elapsed
            stopped = run.why_stop()
            if stopped == "collapse":
                break
            healthy = run.watcher is None or not run.watcher.uneasy
            due = partial(passed, before, state.images, ended=stopped is not None)
            keep = partial(kept, before, state.images, ended=stopped is not None)
            if keep(config.validate_every) and healthy:
                run.validate()
                stopped = run.why_stop() or stopped
                if stopped == "collapse":
                    break
            if due(config.sample_every):
                run.draw()
            if (keep(config.checkpoint_every) and healthy) or stop_asked:
                run.checkpoint()
            if stop_asked and stopped is None:
                run.close()
                raise TrainingInterrupted(
                    f"stopped after {state.images:,} pictures and saved; the same with --resume goes on"
                )
    if stopped == "collapse":
        run.log("collapse", {finding.sign: finding.text for finding in run.findings})
    elif run.ranks.first:
        run.kept.at_end(state)
    run.close()
    took = max(time.perf_counter() - began, 1e-9)
    return TrainResult(
        run.folder.path,
        state.images,
        state.seconds,
        (state.images - images_before) / took,
        run.validation,
        stopped or "images",
        run.findings,
        run.reader.waited_s / took,
        run.kept.images,
    )


def network_precision(precision: str, device: torch.device) -> Precision:
    """A context in which networks run in that precision; geometry and losses are computed outside it."""
    if precision == "32-true":
        return nullcontext
    return partial(torch.autocast, device.type, torch.bfloat16)
