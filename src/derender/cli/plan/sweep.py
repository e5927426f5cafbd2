"""All jobs of a plan: trainings, feature tables and scores, each a library call that is made once.

A job leaves a note beside its result: a key (the hash of its inputs), how it ended, its cost. A job whose
note has the same key is not repeated; a training goes on from its last checkpoint. With several workers each
job has a process of its own, so that one that is killed costs itself alone, and ends with its parent.
"""

import json
import multiprocessing
import os
import re
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from multiprocessing import connection
from pathlib import Path
from typing import Any, Literal

from derender.cli.console import duration, notice, progress_bar
from derender.cli.plan.settings import Plan
from derender.evaluation.memory import content_hash
from derender.storage.atomic import atomic_file

GRACE_SECONDS = 30.0  # after the budget, for a worker to save
LOOK_EVERY_SECONDS = 0.5
COMPONENTS = 64  # of pca and noise


class BudgetUsed(Exception):
    """The time of a comparison is over; the message says for which job."""


class Collapsed(Exception):
    """A training that would collapse again."""


@dataclass(frozen=True)
class Job:
    """One training, feature table or set of scores.

    Attributes:
        kind: which of them.
        method: whose; empty for scores, which are those of all methods.
        where: the training set of a training, else the scored set.
        seed: of the training.
        after: jobs that must have ended, well or not.
    """

    kind: Literal["train", "embed", "score"]
    method: str
    where: str
    seed: int = 0
    after: tuple["Job", ...] = ()

    @property
    def name(self) -> str:
        """In words."""
        relation = {"train": "on", "embed": "of", "score": ""}[self.kind]
        run = f" seed {self.seed}" if self.seed else ""
        return " ".join(f"{self.kind} {self.method}{run} {relation} {self.where}".split())

    @property
    def slug(self) -> str:
        """As a file's name; no two jobs of a plan share one."""
        words = "-".join((self.kind, self.where, self.method, str(self.seed)))
        return f"{re.sub('[^A-Za-z0-9]+', '-', words)}-{content_hash({'name': words})[:6]}"


@dataclass(frozen=True)
class Note:
    """How a job ended.

    Attributes:
        key: hash of its inputs.
        state: done, failed (``why``), or stopped by the budget.
        why: one sentence, where it is not done.
        final: a failure that would come again.
        facts: its cost and results.
    """

    key: str
    state: Literal["done", "failed", "stopped"]
    why: str = ""
    final: bool = False
    facts: Mapping[str, Any] = field(default_factory=dict)


def jobs_of(plan: Plan) -> list[Job]:
    """All of a plan's jobs, each after those it needs; trainings in the order of the plan's data sets."""
    jobs: dict[Job, None] = {}
    scores: list[Job] = []
    for name, scored in plan.score.items():
        tables = []
        for method in plan.rows():
            trained = plan.is_trained(method)
            for seed in range(plan.seeds if trained else 1):
                training = Job("train", plan.source(method), str(scored.trained_on), seed)
                tables.append(Job("embed", method, name, seed, (training,) if trained else ()))
                jobs |= dict.fromkeys((*tables[-1].after, tables[-1]))
        scores.append(Job("score", "", name, 0, tuple(tables)))
    return [*jobs, *scores]


@dataclass
class Sweep:
    """A comparison in its folder: its jobs, and how they stand.

    Attributes:
        work: by kind of job, the function ``(sweep, job, progress) -> facts`` that does it.
    """

    plan: Plan
    path: Path
    device: str = "auto"
    work: Mapping[str, Callable[..., dict[str, Any]]] = field(default_factory=dict)
    deadline: float | None = None
    notes: dict[Job, Note] = field(default_factory=dict)
    began: dict[Job, float] = field(default_factory=dict)

    @property
    def over(self) -> bool:
        """Whether the budget is used."""
        return self.deadline is not None and time.time() >= self.deadline

    def run(self, job: Job) -> Path:
        """The run folder of a training."""
        given = self.plan.methods[job.method].runs.get(job.where)
        name = job.method if job.seed == 0 else f"{job.method}-seed{job.seed}"
        return self.path / "runs" / job.where / name if given is None else Path(given)

    def features(self, job: Job) -> Path:
        """The feature table of a job."""
        return self.path / "features" / f"{job.slug}.parquet"

    def log(self, job: Job) -> Path:
        """The words of a worker, and the traceback of a failure."""
        return self.path / "logs" / f"{job.slug}.log"

    def note(self, job: Job) -> Note | None:
        """The note that a job left; None without one that can be read."""
        try:
            tree = json.loads(self._file(job).read_text())
            return Note(**{name: tree[name] for name in ("key", "state", "why", "final", "facts")})
        except (FileNotFoundError, ValueError, TypeError, KeyError):
            return None

    def leave(self, job: Job, note: Note) -> Note:
        """Write a job's note."""
        with atomic_file(self._file(job)) as temporary:
            temporary.write_text(json.dumps({"job": job.name, **asdict(note)}, indent=1))
        return note

    def _file(self, job: Job) -> Path:
        return self.path / "jobs" / f"{job.slug}.json"

    def key(self, job: Job) -> str:
        """Changes with the settings and files of a job, and with the results of those before it."""
        before = [
            [one.method, one.seed, note.key, note.state] for one in job.after if (note := self.note(one))
        ]
        return content_hash({"before": before, **_inputs(self.plan, job, self.run)})

    def next(self) -> Job | None:
        """A job that can begin now, scores and features before trainings; None if there is none."""
        while True:
            ready = [
                job
                for job in jobs_of(self.plan)
                if job not in self.notes
                and job not in self.began
                and all(one in self.notes for one in job.after)
            ]
            if not ready:
                return None
            job = min(ready, key=lambda one: ("score", "embed", "train").index(one.kind))
            note = self.known(job)
            if note is None:
                self.began[job] = time.perf_counter()
                return job
            self.notes[job] = note

    def known(self, job: Job) -> Note | None:
        """The note of a job that need not be done, or can no longer be."""
        key, note = self.key(job), self.note(job)
        result = {"train": self.run, "embed": self.features}.get(job.kind, lambda _: self.path)(job)
        if (
            note is not None
            and note.key == key
            and (note.final or (note.state == "done" and result.exists()))
        ):
            return note
        before = [self.notes[one] for one in job.after]
        if job.kind == "embed" and before and before[0].state != "done":
            return self.leave(job, Note(key, before[0].state, before[0].why, before[0].final))
        if not self.over or job.kind == "score":
            return None
        images = run_progress(self.run(job))["images"] if job.kind == "train" else None
        seen = f" ({images:,} of {self.plan.images:,} images seen)" if images else ""
        return self.leave(job, Note(key, "stopped", f"the budget was used before its turn{seen}"))

    def perform(self, job: Job) -> Note:
        """Do one job and leave its note, whatever happens in it."""
        try:
            with progress_bar(job.name, unit="steps" if job.kind == "score" else "images") as progress:
                note = Note(self.key(job), "done", facts=self.work[job.kind](self, job, progress))
        except BudgetUsed as error:
            note = Note(self.key(job), "stopped", str(error))
        except Collapsed as error:
            note = Note(self.key(job), "failed", str(error), final=True, facts={"run": str(self.run(job))})
        except Exception as error:
            self.log(job).parent.mkdir(parents=True, exist_ok=True)
            with self.log(job).open("a") as stream:
                traceback.print_exc(file=stream)
            text = " ".join(str(error).split())
            kind = type(error).__name__
            why = text if isinstance(error, ValueError | OSError) and text else f"{kind}: {text}".rstrip(": ")
            note = Note(self.key(job), "failed", why)
        return self.leave(job, note)

    def ended(self, job: Job, note: Note) -> None:
        """Record a job's end, and say so."""
        self.notes[job] = note
        took = duration(time.perf_counter() - self.began.pop(job))
        why = "" if note.state == "done" else f": {note.why}"
        notice(f"[{len(self.notes)}/{len(jobs_of(self.plan))}] {job.name}: {note.state}{why} ({took})")

    def do_all(self, workers: int, minutes: float | None = None) -> None:
        """Do every job that is still needed, until the budget of so many minutes is used.

        Existing results are scored even after the budget: that ends a comparison with its tables.

        Raises:
            ValueError: another process works in the folder.
        """
        self.deadline = None if minutes is None else time.time() + 60 * minutes
        with alone(self.path):
            if workers > 1:
                self._in_processes(workers)
            while (job := self.next()) is not None:
                self.ended(job, self.perform(job))

    def _in_processes(self, workers: int) -> None:
        """Every job in a process of its own, so many at a time."""
        context = multiprocessing.get_context("spawn")
        running: dict[Job, Any] = {}
        try:
            while True:
                while len(running) < workers and (job := self.next()) is not None:
                    self._file(job).unlink(missing_ok=True)
                    fresh = Sweep(self.plan, self.path, self.device, self.work, self.deadline)
                    how = (fresh, job, max(1, _cores() // workers))
                    running[job] = context.Process(target=_work, args=how, name=job.slug)
                    running[job].start()
                if not running:
                    return
                connection.wait([process.sentinel for process in running.values()], LOOK_EVERY_SECONDS)
                late = self.deadline is not None and time.time() > self.deadline + GRACE_SECONDS
                for job, process in list(running.items()):
                    if not process.is_alive():
                        process.join()
                        del running[job]
                        self.ended(job, self.note(job) or self.left_nothing(job, process.exitcode))
                    elif late and job.kind != "score":
                        process.terminate()
        finally:
            for process in running.values():
                process.terminate()
            for process in running.values():
                process.join()

    def left_nothing(self, job: Job, code: int) -> Note:
        """The note of a process that ended without one."""
        if self.over and job.kind != "score":
            return self.leave(
                job, Note(self.key(job), "stopped", "the budget was used while it was under way")
            )
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        return self.leave(job, Note(self.key(job), "failed", f"its process {how}: see {self.log(job)}"))


def run_progress(run: Path) -> dict[str, Any]:
    """Images seen and seconds of training by the last checkpoint; None where there is none."""
    try:
        state = json.loads((run / "checkpoints" / "last" / "state.json").read_text())["state"]
        return {"images": state["images"], "seconds": state["seconds"]}
    except (OSError, ValueError, KeyError, TypeError):
        return {"images": None, "seconds": None}


def _inputs(plan: Plan, job: Job, run: Callable[[Job], Path]) -> dict[str, Any]:
    """Everything of the plan and of its files that decides a job's result."""
    if job.kind == "train":
        learnt = plan.train[job.where]
        if job.where in plan.methods[job.method].runs:
            folder = run(job)
            weights = [folder / "model" / "model.safetensors", folder / "model.safetensors"]
            return {"run": [str(folder), *(_file_facts(str(file)) for file in weights)]}
        config = plan.configuration(job.method, job.where, job.seed).model_dump(mode="json")
        return {"config": config, "data": [_file_facts(learnt.data), learnt.dataset, learnt.limit]}
    scored = plan.score[job.where]
    if job.kind == "score":
        names = {"clustering", "counts", "draws", "untrained_seeds", "resamples", "image_size"}
        return {"how": plan.model_dump(mode="json", include=names), "scored": scored.model_dump(mode="json")}
    method = plan.methods[job.method]
    return {
        "kind": plan.kind(job.method),
        "model": plan.methods[plan.source(job.method)].model,
        "features": [list(method.features), method.whitened, plan.image_size],
        "data": [_file_facts(scored.data), scored.dataset, scored.limit, scored.part],
        "split": None if scored.part == "all" else list(plan.train[str(scored.trained_on)].split),
    }


def _file_facts(path: str) -> list[Any]:
    """A data set's path, and size and time where it is one file."""
    file = Path(path.partition("::")[0])
    status = file.stat() if file.is_file() else None
    return [path] if status is None else [path, status.st_size, status.st_mtime_ns]


def _work(sweep: Sweep, job: Job, threads: int) -> None:
    """A worker process: one job, its words in a file."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    sweep.log(job).parent.mkdir(parents=True, exist_ok=True)
    with sweep.log(job).open("a") as stream:
        os.dup2(stream.fileno(), sys.stdout.fileno())
        os.dup2(stream.fileno(), sys.stderr.fileno())
    if "OMP_NUM_THREADS" not in os.environ:
        import torch

        torch.set_num_threads(threads)
    try:
        sweep.perform(job)
    except KeyboardInterrupt:  # Ctrl-C or SIGTERM: the training is saved, and no note is left
        sys.exit(130)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Hold the folder for this process; the system releases it when the process ends, however it ends."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".lock").open("w") as handle:
        try:
            import fcntl
        except ImportError:  # Windows
            yield
            return
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ValueError(
                f"another derender compare works in {folder}: wait for it, or choose another --out"
            ) from error
        yield
