"""All jobs of a plan: what is there already, what is ready, worker processes, and the end of the budget.

With one worker everything happens in this process; with more each job has a process of its own, so that one
that is killed costs itself alone. A worker whose parent is gone ends, too.
"""

import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import connection
from pathlib import Path
from typing import Any

from derender.cli.console import duration, progress_bar
from derender.cli.plan.asking import score_job, scoring_key
from derender.cli.plan.embedding import embed_job, embedding_key
from derender.cli.plan.jobs import Job, Note, Place, jobs_of
from derender.cli.plan.settings import Plan
from derender.cli.plan.training import BudgetUsed, run_folder, run_progress, train_job, training_key

GRACE_SECONDS = 30.0  # after the budget, for a worker to save what it does
LOOK_EVERY_SECONDS = 0.5
Say = Callable[[str], None]


def run_plan(
    plan: Plan, place: Place, *, workers: int, minutes: float | None, device: str, say: Say
) -> dict[Job, Note]:
    """Do what a plan still needs, until it is done or the budget is used; every job's note comes back.

    What is there is scored even after the budget: that ends a comparison with its tables.

    Raises:
        ValueError: another process works in the folder.
    """
    deadline = None if minutes is None else time.time() + 60 * minutes
    with _alone(place.path):
        state = _Standing(plan, place, device, deadline, say)
        if workers == 1:
            while (job := state.next()) is not None:
                state.ended(job, perform(plan, place, job, device, deadline))
        else:
            _in_processes(state, workers)
        return state.notes


def perform(plan: Plan, place: Place, job: Job, device: str, deadline: float | None) -> Note:
    """Do one job and leave its note; whatever goes wrong in it is a note, too."""
    how: dict[str, Any] = {"device": device}
    try:
        with progress_bar(job.name, unit="steps" if job.kind == "score" else "pictures") as progress:
            if job.kind == "score":
                note = score_job(plan, place, job, **how)
            else:
                how |= {"deadline": deadline, "progress": progress}
                note = (train_job if job.kind == "train" else embed_job)(plan, place, job, **how)
    except Exception as error:
        _log_traceback(place.log(job))
        note = Note(key_of(plan, place, job), "failed", reason(error))
    return place.leave(job, note)


def reason(error: Exception) -> str:
    """Why something failed, on one line."""
    text = " ".join(str(error).split())
    if isinstance(error, ValueError | OSError | BudgetUsed) and text:
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def key_of(plan: Plan, place: Place, job: Job) -> str:
    """What a job's result is made from, by the notes of those before it."""
    if job.kind == "train":
        return training_key(plan, job)
    before = {one: note for one in job.after if (note := place.note(one)) is not None}
    if job.kind == "embed":
        return embedding_key(plan, job, before.get(job.after[0]) if job.after else None)
    return scoring_key(plan, job, before)


class _Standing:
    """Where a comparison stands: what has ended, what is under way."""

    def __init__(self, plan: Plan, place: Place, device: str, deadline: float | None, say: Say):
        self.plan, self.place, self.device, self.deadline, self.say = plan, place, device, deadline, say
        self.jobs, self.busy = jobs_of(plan), set[Job]()
        self.notes: dict[Job, Note] = {}
        self.began: dict[Job, float] = {}

    @property
    def over(self) -> bool:
        """Whether the budget is used."""
        return self.deadline is not None and time.time() >= self.deadline

    def next(self) -> Job | None:
        """A job that can be begun now: scores and features before trainings; None if there is none."""
        while True:
            ready = [
                job
                for job in self.jobs
                if job not in self.notes
                and job not in self.busy
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
        """How a job ended that need not be done, or can no longer be."""
        key, note = key_of(self.plan, self.place, job), self.place.note(job)
        if note is not None and note.key == key and (note.final or self._whole(job, note)):
            return note
        before = [self.notes[one] for one in job.after]
        if job.kind == "embed" and before and before[0].state != "done":
            return self.place.leave(job, Note(key, before[0].state, before[0].why, before[0].final))
        if not self.over or job.kind == "score":
            return None
        why = "the budget was used before its turn"
        if job.kind == "train":
            seen = run_progress(run_folder(self.plan, self.place, job))["images"]
            why += f" ({seen:,} of {self.plan.images:,} pictures seen)" if seen else ""
        return self.place.leave(job, Note(key, "stopped", why))

    def _whole(self, job: Job, note: Note) -> bool:
        """Whether a job was done and its result still lies there."""
        if note.state != "done":
            return False
        if job.kind == "train":
            return (Path(note.facts["run"])).is_dir()
        return job.kind == "score" or self.place.features(job).is_file()

    def ended(self, job: Job, note: Note) -> None:
        self.notes[job] = note
        self.busy.discard(job)
        took = duration(time.perf_counter() - self.began[job])
        what = (
            f"{job.name}: {note.state}" if note.state == "done" else f"{job.name}: {note.state}: {note.why}"
        )
        self.say(f"[{len(self.notes)}/{len(self.jobs)}] {what} ({took})")


def _in_processes(state: _Standing, workers: int) -> None:
    """Every job in a process of its own, so many at a time."""
    context = multiprocessing.get_context("spawn")
    threads = max(1, _cores() // workers)
    running: dict[Job, Any] = {}
    try:
        while True:
            while len(running) < workers and (job := state.next()) is not None:
                state.place.forget(job)
                how = (state.plan, state.place, job, state.device, state.deadline, threads)
                running[job] = context.Process(target=_work, args=how, name=job.slug)
                running[job].start()
                state.busy.add(job)
            if not running:
                return
            connection.wait([process.sentinel for process in running.values()], LOOK_EVERY_SECONDS)
            late = state.deadline is not None and time.time() > state.deadline + GRACE_SECONDS
            for job, process in list(running.items()):
                if process.is_alive():
                    if late and job.kind != "score":
                        process.terminate()
                    continue
                process.join()
                del running[job]
                state.ended(job, state.place.note(job) or _left_nothing(state, job, process.exitcode))
    finally:
        for process in running.values():
            process.terminate()
        for process in running.values():
            process.join()


def _left_nothing(state: _Standing, job: Job, code: int) -> Note:
    """The note of a process that ended without one."""
    key = key_of(state.plan, state.place, job)
    if state.over and job.kind != "score":
        note = Note(key, "stopped", "the budget was used while it was under way")
    else:
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        note = Note(key, "failed", f"its process {how}: see {state.place.log(job)}")
    return state.place.leave(job, note)


def _work(plan: Plan, place: Place, job: Job, device: str, deadline: float | None, threads: int) -> None:
    """A worker process: one job, its words in a file."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    log = place.log(job)
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as stream:
        os.dup2(stream.fileno(), sys.stdout.fileno())
        os.dup2(stream.fileno(), sys.stderr.fileno())
    if "OMP_NUM_THREADS" not in os.environ:
        import torch

        torch.set_num_threads(threads)
    try:
        perform(plan, place, job, device, deadline)
    except KeyboardInterrupt:  # Ctrl-C or SIGTERM: what was trained is saved, and no note is left
        sys.exit(130)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


def _log_traceback(log: Path) -> None:
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as stream:
        traceback.print_exc(file=stream)


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold the folder for this process; the system lets go of it when the process ends, however it ends."""
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
