"""The training loop: one process or many (Lightning Fabric), resumable to the same weights.

Everything random is a function of the seed and the number of images seen. So weights, optimiser and counters
are enough to continue where a run stopped.
"""

import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Mapping
from functools import partial
from itertools import count, groupby, takewhile
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Generator, Tensor

from derender.data import ImageSet, split_indices
from derender.storage.atomic import DamageNoticed, atomic_file
from derender.storage.folder import SplitRecord, write_split
from derender.training import checkpoint, process, run_folder
from derender.training import task as tasks
from derender.training.batches import Reader, batches_of, random_stream
from derender.training.distributed import Ranks, open_fabric
from derender.training.faster import Replayed, compile_networks
from derender.training.watch import Finding, largest_gradients, not_finite

SAMPLE_COUNT = 8
LOG_EVERY_STEPS = 50
READ_EVERY_STEPS = 16  # steps whose notes the host reads at once; between, it never waits for the device
MAX_VALIDATION_IMAGES = 1_000
FIRST_KEPT_IMAGES = 300  # about when the first state of a run with long intervals is kept
NOT_RECONSTRUCTION = ("l1", "loocc", "cycle")

SampleSheet = Callable[[Any, Tensor], Image.Image]  # draws a model's output for a few images


def train_task(task: tasks.TrainingTask, images: ImageSet, out: str | Path, **how: Any) -> tasks.TrainResult:
    """Train any task; arguments, files and errors are those of `derender.training.train`."""
    images.require(10)
    with process.deterministic_algorithms(task.config.deterministic), process.locked(Path(out)):
        run = _Run(task, images, Path(out), **how)
        with process.freed_memory_kept(run.fabric.device):
            return run.go_on()


class _Run:
    """A run in progress: everything that lasts from one step to the next."""

    def __init__(
        self, task: tasks.TrainingTask, images: ImageSet, out: Path, *, resume: bool = False,
        sample_sheet: SampleSheet | None = None, progress: Callable[[tasks.Progress], None] | None = None,
        accelerator: str = "auto",
    ):  # fmt: skip
        config = self.config = task.config
        self.report, self.sample_sheet = progress or (lambda _: None), sample_sheet
        fabric = self.fabric = open_fabric(accelerator)
        ranks = self.ranks = Ranks(fabric.global_rank, fabric.world_size)
        self.task = task = task.shared(ranks) if ranks.count > 1 else task
        split = split_indices(images.files, config.split, seed=config.seed)
        batches = batches_of(images.images, split.train, config, fabric.device)
        self.reader, self.train_rows = Reader(batches, ranks), torch.from_numpy(split.train)
        self.model: Any = task.build().to(fabric.device)
        if config.channels_last:
            self.model.to(memory_format=torch.channels_last)  # pyrefly: ignore[no-matching-overload]
        self.folder = run_folder.RunFolder(out)
        if ranks.first and resume:
            run_folder.reopen_run(out, config, run_folder.describe_data(images, split))
        elif ranks.first:
            device = f"{ranks.count} x {fabric.device.type}" if ranks.count > 1 else str(fabric.device)
            run_folder.start_run(out, config, run_folder.describe_data(images, split), device)
        phase = tasks.Progress.of("perceptual", self.report)
        with fabric.rank_zero_first():
            losses = task.losses(self.model, self.folder, batches.sample(), phase)
        how = config.optimiser.model_dump(include={"betas", "weight_decay"})
        rate = config.optimiser.learning_rate
        on_gpu = fabric.device.type == "cuda"
        self.optimiser = torch.optim.Adam(_groups(self.model), rate, **how, fused=True, capturable=on_gpu)
        self.module = fabric.setup_module(tasks.Step(self.model, losses))
        self.precision = tasks.network_precision(config.precision, fabric.device)
        held_out = split.validation[:MAX_VALIDATION_IMAGES]
        self.held_rows = torch.from_numpy(held_out)
        self.held_out = torch.from_numpy(np.ascontiguousarray(images.images[held_out])).to(fabric.device)
        both = self.folder.last, self.folder.previous  # of a new run neither is there
        self.state, note = checkpoint.resume_from(*both, self.model, self.optimiser)
        self.expected_images = self.state.expected_images(config)
        self.fell_back = note is not None  # the damaged checkpoint is not to become the previous one
        self.watcher = task.watch(self.state.watcher) if config.watch else None
        self.validation: dict[str, float] = {}
        self.findings: tuple[Finding, ...] = ()
        self.notes: list[tuple[int, list[str], list[str], Tensor]] = []
        self.broken = torch.zeros((), device=fabric.device)
        """1 as soon as a gradient is not finite: from there on no step changes the weights."""
        for group in self.optimiser.param_groups if on_gpu else ():
            group["lr"] = torch.zeros((), device=fabric.device)  # which a recorded step reads
        self.noise = Generator(fabric.device) if on_gpu and task.replayable else None
        self.replayed = None
        if self.noise is not None and ranks.count == 1 and config.cuda_graph == "auto":
            self.replayed = Replayed(partial(self.update, noise=self.noise), self.noise, self.note)
        self.uncompiled = config.compile == "auto" and ranks.count == 1 and not config.deterministic
        self.model_images: int | None = None
        self.writer: Any = None
        if ranks.first:
            run_folder.drop_metrics_after(self.folder, self.state.images)
            from torch.utils.tensorboard.writer import SummaryWriter

            self.writer = SummaryWriter(str(out / "tensorboard"), purge_step=self.state.images)
            if note is not None:
                self.note(note)

    def go_on(self) -> tasks.TrainResult:
        """Train from where the run stands until something ends it."""
        config, state = self.config, self.state
        began, images_before, seconds_before = time.perf_counter(), state.images, state.seconds
        stopped, steps = self.why_stop(), 0
        with process.stop_on_signal() as signals:
            while stopped is None:
                before = state.images
                result = self.step()
                steps += 1
                elapsed = time.perf_counter() - began
                state.seconds, speed = seconds_before + elapsed, (state.images - images_before) / elapsed
                waiting, terms = self.reader.waited_s / elapsed, None
                total = max(state.images, self.expected_images)
                if steps % LOG_EVERY_STEPS == 1:
                    terms = self.ranks.mean(_on_host(result.terms))
                    self.log("train", {**terms, "images_per_second": speed, "waiting": waiting})
                self.report(tasks.Progress("train", state.images, total, speed, terms, waiting))

                span = before, state.images
                if self.position % READ_EVERY_STEPS and not self.due(*span, stop=signals.is_set()):
                    continue
                elapsed, interrupted = self.ranks.largest(elapsed, signals.is_set())
                state.seconds = seconds_before + elapsed
                self.expected_images = state.expected_images(config)
                self.read_notes()
                stopped = self.why_stop()
                healthy = stopped != "collapse" and (self.watcher is None or not self.watcher.uneasy)
                ended = stopped is not None
                if healthy and kept(*span, config.validate_every, ended=ended):
                    self.validate()
                    stopped = self.why_stop() or stopped
                if stopped == "collapse":
                    break
                if passed(*span, config.sample_every, ended=ended):
                    self.draw()
                if interrupted or (healthy and kept(*span, config.checkpoint_every, ended=ended)):
                    self.checkpoint()
                if interrupted and stopped is None:
                    self.close()
                    done = f"stopped after {state.images:,} images and saved"
                    raise process.TrainingInterrupted(f"{done}; the same with --resume continues")
        if stopped == "collapse":
            self.log("collapse", {finding.sign: finding.text for finding in self.findings})
        elif self.ranks.first:
            self.leave_model()
        self.close()
        took = max(time.perf_counter() - began, 1e-9)
        speed, waiting = (state.images - images_before) / took, self.reader.waited_s / took
        return tasks.TrainResult(
            self.folder.path, state.images, state.seconds, speed, self.validation, stopped or "images",
            self.findings, waiting, self.model_images,
        )  # fmt: skip

    @property
    def position(self) -> int:
        """Batches that the weights have seen."""
        return self.state.images // self.config.batch_size

    def step(self) -> tasks.StepLosses:
        """One batch: losses, gradients, update, watcher."""
        config, state = self.config, self.state
        position, done = self.position, state.images / self.expected_images
        watched = self.watcher if position % READ_EVERY_STEPS == 0 else None
        if watched is not None and (repaired := watched.repair(self.model, self.optimiser)):
            self.note(repaired)
        for group in self.optimiser.param_groups:
            rate = group.get("share", 1.0) * config.optimiser.rate(state.images, self.expected_images)
            group["lr"] = group["lr"].fill_(rate) if isinstance(group["lr"], Tensor) else rate
        drawn = random_stream(config.seed, "perturb", position)
        if self.noise is not None:
            self.noise.manual_seed(drawn.initial_seed())
        images = self.reader.at(position)
        rows = self.train_rows[self.reader.batches.order(position, self.ranks)]
        if self.uncompiled:
            self.uncompiled = False
            trial = partial(self.trial, images, done, rows)
            state.compiled = compile_networks(self.model, trial, self.note, state.compiled)
        if self.replayed is not None:
            (result, gradients, stages), note = self.replayed(images, done, self.task.phase(done))
        else:
            (result, gradients, stages), note = self.update(images, done, self.noise or drawn, rows)
        state.images += config.batch_size
        self.notes.append((state.images, gradients, stages, note))
        return result

    def trial(self, images: Tensor, done: float, rows: Tensor) -> float:
        """The loss of a batch; its gradients are computed, too, and change nothing."""
        noise = Generator(images.device if self.noise is not None else "cpu").manual_seed(0)
        result = tasks.compute_step(self.module, images, noise, self.precision, done, rows)
        self.fabric.backward(result.total)
        self.optimiser.zero_grad(set_to_none=True)
        return result.total.item()

    def update(
        self, images: Tensor, done: float, noise: Generator, rows: Tensor | None = None
    ) -> tuple[tuple[tasks.StepLosses, list[str], list[str]], Tensor]:
        """Change the weights by a batch: its losses, names of gradients and stages, and notes of both."""
        # nothing here waits for the device
        self.optimiser.zero_grad(set_to_none=True)  # a recording that failed may have left some
        result = tasks.compute_step(self.module, images, noise, self.precision, done, rows)
        self.fabric.backward(result.total)
        gradients, largest = largest_gradients(self.model)
        self.broken.copy_(torch.maximum(self.broken, 1 - largest.isfinite().all().float()))
        self.optimiser.found_inf = self.broken  # pyrefly: ignore[missing-attribute]
        self.optimiser.step()
        self.optimiser.zero_grad(set_to_none=True)
        stages, note = ([], largest[:0]) if self.watcher is None else self.watcher.note(result)
        return (result, gradients, stages), torch.cat([largest, note])

    def due(self, before: int, now: int, *, stop: bool) -> bool:
        """Whether something is to be done that needs the notes of the steps so far; all ranks agree."""
        config, stop = self.config, self.ranks.count == 1 and (stop or self.why_stop() is not None)
        often = config.validate_every, config.checkpoint_every, config.sample_every
        return stop or any(kept(before, now, every, ended=now >= config.images) for every in often)

    def read_notes(self) -> None:
        """Let the watcher look at every step since the last time; the first fatal one ends the run there."""
        notes, self.notes = self.notes, []
        numbers = torch.cat([note for *_, note in notes]).cpu().split([len(note) for *_, note in notes])
        for (images, gradients, stages, _), note in zip(notes, numbers, strict=True):
            own = note.tolist()
            if self.watcher is not None:
                self.findings = self.watcher.look(images, stages, own[len(gradients) :])
            pairs = zip(gradients, own, strict=False)
            broken = next((name for name, size in pairs if not isfinite(size)), None)
            if broken is not None and not any(finding.fatal for finding in self.findings):
                self.findings = (*self.findings, not_finite(broken))
            if any(finding.fatal for finding in self.findings):
                self.state.images = images
                return

    def why_stop(self) -> str | None:
        """The reason that ends the run now, if there is one."""
        if any(finding.fatal for finding in self.findings):
            return "collapse"
        return self.state.ended_by(self.config)

    def validate(self) -> None:
        """Score held-out images; keep the weights if they are the best so far."""
        if not len(self.held_out):
            return
        state, self.validation = self.state, self.held_out_losses()
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
            checkpoint.save_checkpoint(self.folder.best, self.model, self.optimiser, state)
            if self.config.keep == "best":
                self.save_model(state.images)

    @torch.no_grad()
    def held_out_losses(self) -> dict[str, float]:
        """Mean losses over held-out images, shared by the ranks; "loss" sums those the task judges by."""
        sums: dict[str, float] = defaultdict(float)
        seen, size = 0, self.config.batch_size
        batches = zip(self.held_out.split(size), self.held_rows.split(size), strict=True)
        with process.evaluating(self.module):
            for position, (batch, rows) in enumerate(batches):
                if len(batch) < 2 and seen:
                    break
                seen += len(batch)
                if position % self.ranks.count == self.ranks.rank:
                    noise, images = random_stream(self.config.seed, "perturb", position), batch.float() / 255
                    result = tasks.compute_step(self.module, images, noise, self.precision, rows=rows)
                    for name, value in _on_host(result.terms).items():
                        sums[name] += value * len(batch)
        means = {name: value / max(seen, 1) for name, value in self.ranks.sum(sums).items()}
        return {"loss": sum(means[name] for name in means if name not in self.task.outside_loss), **means}

    def draw(self) -> None:
        """Write a sheet of decomposed held-out images."""
        if self.sample_sheet is None or not len(self.held_out) or not self.ranks.first:
            return
        with process.evaluating(self.model), torch.no_grad():
            sheet = self.sample_sheet(self.model, self.held_out[:SAMPLE_COUNT].float() / 255)
        with atomic_file(self.folder.samples / f"{self.state.images:09d}.png") as temporary:
            sheet.save(temporary, format="PNG")

    def checkpoint(self) -> None:
        """Write everything a resumed run needs; the first one of all leaves a model in any case."""
        if not self.ranks.first:
            return
        self.state.watcher = self.watcher.memory() if self.watcher is not None else {}
        last, previous = self.folder.last, None if self.fell_back else self.folder.previous
        checkpoint.save_checkpoint(last, self.model, self.optimiser, self.state, previous=previous)
        self.fell_back = False
        if self.config.keep == "last" or not self.folder.model.exists():
            self.save_model(self.state.images)

    def leave_model(self) -> None:
        """Leave the weights that the settings name, or without validation the last."""
        if self.config.keep == "last" or self.state.best_loss is None:
            if self.model_images != self.state.images:
                self.save_model(self.state.images)
        elif self.model_images is None:
            try:
                best = checkpoint.load_checkpoint(self.folder.best, self.model, None)
            except (checkpoint.DamagedCheckpoint, FileNotFoundError):
                note = f"{self.folder.best} is damaged or missing: {self.folder.model} stays as it is"
                warnings.warn(note, DamageNoticed, stacklevel=2)
            else:
                self.save_model(best.images)

    def save_model(self, images: int) -> None:
        """Save the model, whose weights have seen so many images, with the run's split."""
        self.model.save(self.folder.model, overwrite=True)
        write_split(self.folder.model, SplitRecord(self.config.split, self.config.seed))
        self.model_images = images

    def log(self, kind: str, values: dict[str, Any]) -> None:
        """Add a line to metrics.jsonl, and its numbers to TensorBoard."""
        if self.writer is None:
            return
        images, seconds = self.state.images, round(self.state.seconds, 2)
        run_folder.append_metrics(self.folder, {"kind": kind, "images": images, "seconds": seconds, **values})
        for name, value in values.items():
            if isinstance(value, float):
                self.writer.add_scalar(f"{kind}/{name}", value, images)

    def note(self, text: str) -> None:
        self.log("note", {"text": text})

    def close(self) -> None:
        self.reader.close()
        if self.writer is not None:
            self.writer.close()


def _groups(model: Any) -> list[dict[str, Any]]:
    """Parameters in their order; networks of a renderer's few numbers have their own rate, without decay."""
    # their gradients are small beside the decay: it would carry their weights to 0
    rows = [row for row in getattr(model, "factors", ()) if row.numbers]
    rates = {id(parameter): row.rate for row in rows for parameter in model.nets[row.name].parameters()}
    return [
        {"params": list(part)} | ({} if rate is None else {"share": rate, "weight_decay": 0.0})
        for rate, part in groupby(model.parameters(), lambda parameter: rates.get(id(parameter)))
    ]


def _on_host(terms: Mapping[str, Tensor]) -> dict[str, float]:
    return dict(zip(terms, torch.stack([value.float() for value in terms.values()]).tolist(), strict=True))


def passed(before: int, now: int, interval: int, *, ended: bool) -> bool:
    """Whether a multiple of ``interval`` lies in (before, now], or the run has ended."""
    return ended or now // interval > before // interval


def kept(before: int, now: int, interval: int, *, ended: bool) -> bool:
    """As ``passed``, and at halves of the first interval, so that an early collapse leaves a good state."""
    halves = takewhile(lambda at: at >= FIRST_KEPT_IMAGES, (interval // 2**half for half in count(1)))
    return passed(before, now, interval, ended=ended) or any(before < early <= now for early in halves)
