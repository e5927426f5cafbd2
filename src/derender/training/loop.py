"""The training loop: one process or many (Lightning Fabric), resumable to the same weights.

Everything random is a function of the seed and the number of images seen, so the loop needs only weights,
optimiser and counters to go on where it stopped.
"""

import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Int64, UInt8
from PIL import Image
from torch import Tensor, nn
from torch.utils.tensorboard.writer import SummaryWriter

from derender.data import ImageSet, split_indices
from derender.storage.atomic import atomic_file
from derender.training.batches import Batches, Reader, batches_of, random_stream
from derender.training.checkpoint import ModelOfRun, TrainState, resume_from, save_checkpoint
from derender.training.config import LoopSettings
from derender.training.distributed import ALONE, Ranks, first_then_others, open_fabric, ranks_of
from derender.training.process import (
    TrainingInterrupted,
    deterministic_algorithms,
    freed_memory_kept,
    stop_on_signal,
)
from derender.training.run_folder import (
    RunFolder,
    append_metrics,
    describe_data,
    drop_metrics_after,
    reopen_run,
    start_run,
)
from derender.training.task import (
    Precision,
    Progress,
    StepLosses,
    TrainingTask,
    TrainResult,
    Watch,
    compute_step,
    network_precision,
)
from derender.training.watch import Finding, broken_gradient, not_finite

SAMPLE_COUNT = 8
LOG_EVERY_STEPS = 50
MAX_VALIDATION_IMAGES = 1_000
FIRST_KEPT_IMAGES = 300
"""About when the first state of a run with long intervals is kept."""
NOT_RECONSTRUCTION = ("l1", "loocc", "cycle")

SampleSheet = Callable[[Any, Tensor], Image.Image]
"""Draws a model's output for a few images."""


def train_task(
    task: TrainingTask,
    pictures: ImageSet,
    out: str | Path,
    *,
    resume: bool = False,
    sample_sheet: SampleSheet | None = None,
    progress: Callable[[Progress], None] | None = None,
    accelerator: str = "auto",
) -> TrainResult:
    """Train any task; arguments, files and errors are those of `derender.training.train`."""
    config, out, report = task.config, Path(out), progress or (lambda _: None)
    pictures.require(10)
    with deterministic_algorithms(config.deterministic):
        fabric = open_fabric(accelerator, every_parameter_learns=task.every_parameter_learns)
        ranks = ranks_of(fabric)
        if ranks.count > 1:
            task = task.shared(ranks)
        split = split_indices(pictures.files, config.split, seed=config.seed)
        batches = batches_of(pictures.images, split.train, config, fabric.device)
        task.check()
        if not ranks.first:
            folder = RunFolder(out)
        elif resume:
            folder = reopen_run(out, config)
        else:
            device = f"{ranks.count} x {fabric.device.type}" if ranks.count > 1 else str(fabric.device)
            folder = start_run(out, config, describe_data(pictures, split), device)
        model = task.build().to(fabric.device)
        if config.channels_last:
            model = model.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        with first_then_others(fabric):
            step = task.step_module(
                model, folder, batches.sample(), lambda *counts: report(Progress("perceptual", *counts))
            )
        how = config.optimiser.model_dump(include={"betas", "weight_decay"})
        optimiser = torch.optim.Adam(model.parameters(), config.optimiser.learning_rate, **how, fused=True)
        train_rows = torch.from_numpy(split.train)
        module, wrapped = fabric.setup(step, optimiser)
        run = _Run(task, folder, fabric, ranks, module, wrapped, batches, train_rows)
        note = None
        if resume:
            run.state, note = resume_from(folder.last, folder.previous, model, optimiser)
        for group in optimiser.param_groups:
            group.update(how)
        held_rows = split.validation[:MAX_VALIDATION_IMAGES]
        held_out = torch.from_numpy(np.ascontiguousarray(pictures.images[held_rows]))
        run.begin(fabric.to_device(held_out), torch.from_numpy(held_rows), sample_sheet, note)
        with freed_memory_kept() if fabric.device.type == "cpu" else nullcontext():
            return run.go_on(report)


class _Run:
    """A run in progress: everything that lasts from one step to the next."""

    def __init__(
        self,
        task: TrainingTask,
        folder: RunFolder,
        fabric: Any,
        ranks: Ranks,
        module: nn.Module,
        optimiser: torch.optim.Optimizer,
        batches: Batches,
        train_rows: Tensor,
    ):
        self.task, self.folder, self.fabric, self.ranks = task, folder, fabric, ranks
        self.module, self.optimiser, self.config = module, optimiser, task.config
        self.model: nn.Module = module.model  # type: ignore[assignment]
        self.precision = network_precision(self.config.precision, fabric.device)
        self.reader, self.train_rows = Reader(batches, ranks), train_rows
        self.saved = ModelOfRun(folder, self.model, self.config.keep)
        self.state = TrainState()
        self.validation: dict[str, float] = {}
        self.findings: tuple[Finding, ...] = ()
        self.writer: SummaryWriter | None = None
        self.watcher: Watch | None = None

    def begin(
        self, held_out: Tensor, held_rows: Tensor, sample_sheet: SampleSheet | None, note: str | None
    ) -> None:
        """Set what depends on the state that the run begins or resumes with.

        A ``note`` on a damaged checkpoint is logged: that checkpoint is not to become the previous one.
        """
        self.held_out, self.held_rows = held_out, held_rows
        self.sample_sheet, self.fell_back = sample_sheet, note is not None
        if self.config.watch:
            self.watcher = self.task.watch(self.state.watcher)
        if self.ranks.first:
            drop_metrics_after(self.folder, self.state.images)
            if note is not None:
                append_metrics(self.folder, {"kind": "note", "images": self.state.images, "text": note})
            self.writer = SummaryWriter(str(self.folder.path / "tensorboard"), purge_step=self.state.images)

    def close(self) -> None:
        """Finish all writing."""
        self.reader.close()
        if self.writer is not None:
            self.writer.close()

    def step(self) -> StepLosses:
        """One batch: losses, gradients, update, watcher."""
        config, state = self.config, self.state
        position = state.images // config.batch_size
        for group in self.optimiser.param_groups:
            group["lr"] = config.optimiser.rate(state.images, config.images)
        noise = random_stream(config.seed, "perturb", position)
        done = state.images / config.images
        rows = self.train_rows[self.reader.batches.order(position, self.ranks)]
        result = compute_step(self.module, self.reader.at(position), noise, self.precision, done, rows)
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
        """Score held-out images; keep the weights if they are the best so far."""
        if not len(self.held_out):
            return
        outside, state = self.task.outside_loss, self.state
        self.validation = validate(
            self.module, self.held_out, self.held_rows, self.config, self.precision, outside, self.ranks
        )
        loss = self.validation["loss"]
        self.log("validation", self.validation)
        if not isfinite(loss):
            self.findings = (*self.findings, not_finite("the loss of held-out images"))
            return
        if state.best_loss is not None and not loss < state.best_loss:
            state.validations_since_best += 1
            return
        state.best_loss, state.validations_since_best = loss, 0
        if self.ranks.first:
            save_checkpoint(self.folder.best, self.model, self.optimiser, state)
            self.saved.at_best(state.images)

    def draw(self) -> None:
        """Write a sheet of decomposed held-out images."""
        if self.sample_sheet is None or not len(self.held_out) or not self.ranks.first:
            return
        self.model.eval()
        with torch.no_grad():
            sheet = self.sample_sheet(self.model, self.held_out[:SAMPLE_COUNT].float() / 255)
        self.model.train()
        with atomic_file(self.folder.samples / f"{self.state.images:09d}.png") as temporary:
            sheet.save(temporary, format="PNG")

    def checkpoint(self) -> None:
        """Write everything a resumed run needs."""
        if not self.ranks.first:
            return
        self.state.watcher = self.watcher.memory() if self.watcher is not None else {}
        previous = None if self.fell_back else self.folder.previous
        save_checkpoint(self.folder.last, self.model, self.optimiser, self.state, previous=previous)
        self.fell_back = False
        self.saved.at_checkpoint(self.state.images)

    def log(self, kind: str, values: dict[str, Any]) -> None:
        """Add a line to metrics.jsonl, and its numbers to TensorBoard."""
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
        """The reason that ends the run now, if there is one."""
        config, state = self.config, self.state
        if any(finding.fatal for finding in self.findings):
            return "collapse"
        if state.images >= config.images:
            return "images"
        if config.minutes is not None and state.seconds >= 60 * config.minutes:
            return "minutes"
        return "patience" if state.validations_since_best >= config.patience else None

    def go_on(self, report: Callable[[Progress], None]) -> TrainResult:
        """Train from where the run stands until something ends it."""
        config, state = self.config, self.state
        began, images_before, seconds_before = time.perf_counter(), state.images, state.seconds
        stopped, steps = self.why_stop(), 0
        with stop_on_signal() as signals:
            while stopped is None:
                before = state.images
                result = self.step()
                steps += 1
                elapsed = time.perf_counter() - began
                state.seconds, speed = seconds_before + elapsed, (state.images - images_before) / elapsed
                waiting = self.reader.waited_s / elapsed
                terms = None
                if steps % LOG_EVERY_STEPS == 1:
                    terms = self.ranks.mean({name: value.item() for name, value in result.terms.items()})
                    self.log("train", {**terms, "images_per_second": speed, "waiting": waiting})
                report(Progress("train", state.images, config.images, speed, terms, waiting))

                elapsed, stop_requested = self.ranks.largest(elapsed, signals.requested)
                state.seconds = seconds_before + elapsed
                stopped = self.why_stop()
                if stopped == "collapse":
                    break
                healthy = self.watcher is None or not self.watcher.uneasy
                due = partial(passed, before, state.images, ended=stopped is not None)
                keep = partial(kept, before, state.images, ended=stopped is not None)
                if keep(config.validate_every) and healthy:
                    self.validate()
                    stopped = self.why_stop() or stopped
                    if stopped == "collapse":
                        break
                if due(config.sample_every):
                    self.draw()
                if (keep(config.checkpoint_every) and healthy) or stop_requested:
                    self.checkpoint()
                if stop_requested and stopped is None:
                    self.close()
                    raise TrainingInterrupted(
                        f"stopped after {state.images:,} images and saved; the same with --resume goes on"
                    )
        if stopped == "collapse":
            self.log("collapse", {finding.sign: finding.text for finding in self.findings})
        elif self.ranks.first:
            self.saved.at_end(state)
        self.close()
        took = max(time.perf_counter() - began, 1e-9)
        return TrainResult(
            self.folder.path,
            state.images,
            state.seconds,
            (state.images - images_before) / took,
            self.validation,
            stopped or "images",
            self.findings,
            self.reader.waited_s / took,
            self.saved.images,
        )


@torch.no_grad()
def validate(
    module: nn.Module,
    held_out: UInt8[Tensor, "n 3 h w"],
    held_rows: Int64[Tensor, " n"],
    config: LoopSettings,
    precision: Precision,
    outside_loss: tuple[str, ...] = NOT_RECONSTRUCTION,
    ranks: Ranks = ALONE,
) -> dict[str, float]:
    """Mean losses over held-out images; "loss" is the sum of all but those ``outside_loss``.

    Of several ``ranks`` each judges some of the batches, as one process would all of them.
    """
    module.eval()
    sums: dict[str, float] = defaultdict(float)
    count = 0
    batches = zip(held_out.split(config.batch_size), held_rows.split(config.batch_size), strict=True)
    for position, (batch, rows) in enumerate(batches):
        if len(batch) < 2 and count:
            break
        count += len(batch)
        if position % ranks.count != ranks.rank:
            continue
        noise = random_stream(config.seed, "perturb", position)
        result = compute_step(module, batch.float() / 255, noise, precision, rows=rows)
        for name, value in result.terms.items():
            sums[name] += value.item() * len(batch)
    module.train()
    means = {name: value / max(count, 1) for name, value in ranks.sum(sums).items()}
    return {"loss": sum(value for name, value in means.items() if name not in outside_loss), **means}


def passed(before: int, now: int, interval: int, *, ended: bool) -> bool:
    """Whether a multiple of ``interval`` lies in (before, now], or the run has ended."""
    return ended or now // interval > before // interval


def kept(before: int, now: int, interval: int, *, ended: bool) -> bool:
    """Whether a state in (before, now] is to be kept: as ``passed``, and at halves of the first interval.

    Those (half, a quarter, ... down to ``FIRST_KEPT_IMAGES``) see to it that a collapse, which happens early
    if at all, leaves a good state behind whatever the interval.
    """
    early = interval // 2
    while early >= FIRST_KEPT_IMAGES:
        if before < early <= now:
            return True
        early //= 2
    return passed(before, now, interval, ended=ended)
