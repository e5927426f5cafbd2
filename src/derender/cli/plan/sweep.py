"""All jobs of a plan, each done once: features and scores before further trainings, until the budget is used.

With several workers each job has a process of its own, so that one that is killed costs itself alone, and
ends with its parent.
"""

import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from math import inf
from multiprocessing import connection

import torch
from filelock import FileLock, Timeout

from derender.cli.console import duration, notice, progress_bar
from derender.cli.plan.jobs import (
    Collapsed,
    Comparison,
    Job,
    Note,
    embed,
    jobs_of,
    run_progress,
    score,
    train,
)
from derender.training import TrainingInterrupted

GRACE_SECONDS = 30.0  # after the budget, for a worker to save
WORK = {"score": score, "embed": embed, "train": train}  # in the order of preference


def do_all(at: Comparison, workers: int = 1, minutes: float | None = None) -> dict[Job, Note]:
    """Do every job that is still needed until the budget of so many minutes is used; the note of each.

    Existing results are scored even after the budget: that ends a comparison with its tables.

    Raises:
        ValueError: another process works in the folder.
    """
    jobs, notes, began = jobs_of(at.plan), {}, {}
    running: dict[Future[Note], Job] = {}

    def next_job() -> Job | None:
        waiting = [job for job in jobs if job not in notes and job not in began]
        ready = [job for job in waiting if notes.keys() >= set(job.after)]
        for job in sorted(ready, key=lambda one: list(WORK).index(one.kind)):
            if (note := _known(at, job, notes)) is None:
                began[job] = time.perf_counter()
                return job
            notes[job] = note
        return next_job() if ready else None

    def ended(job: Job, note: Note) -> None:
        notes[job] = note
        took = duration(time.perf_counter() - began[job])
        why = "" if note.state == "done" else f": {note.why}"
        notice(f"[{len(notes)}/{len(jobs)}] {job.name}: {note.state}{why} ({took})")

    at.deadline = inf if minutes is None else time.time() + 60 * minutes
    at.path.mkdir(parents=True, exist_ok=True)
    if workers > 1:
        os.environ.setdefault("OMP_NUM_THREADS", str(max(1, torch.get_num_threads() // workers)))
    try:
        with FileLock(at.path / ".lock", timeout=0), ThreadPoolExecutor(workers) as pool:
            while True:
                while len(running) < workers and (job := next_job()) is not None:
                    if workers == 1:
                        ended(job, perform(at, job))
                    else:
                        running[pool.submit(_apart, at, job)] = job
                if not running:
                    return notes
                for done in wait(running, return_when=FIRST_COMPLETED).done:
                    ended(running.pop(done), done.result())
    except Timeout as error:
        raise ValueError(
            f"another derender compare works in {at.path}: wait for it, or choose another --out"
        ) from error
    except KeyboardInterrupt as stop:
        raise KeyboardInterrupt("stopped and saved; the same command goes on where it stopped") from stop


def perform(at: Comparison, job: Job) -> Note:
    """Do one job and leave its note, whatever happens in it."""
    try:
        with progress_bar(job.name, unit="steps" if job.kind == "score" else "images") as progress:
            return at.leave(job, facts=WORK[job.kind](at, job, progress))
    except TrainingInterrupted:
        if not at.over:
            raise
        return at.leave(job, "stopped", f"the budget was used before it was done{_seen(at, job)}")
    except Exception as error:
        log = at.file("logs", job, ".log")
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("a") as stream:
            traceback.print_exc(file=stream)
        why, kind = " ".join(str(error).split()), type(error).__name__
        if not why or not isinstance(error, ValueError | OSError):
            why = f"{kind}: {why}".rstrip(": ")
        return at.leave(job, "failed", why, final=isinstance(error, Collapsed))


def _known(at: Comparison, job: Job, notes: dict[Job, Note]) -> Note | None:
    """The note of a job that need not be done, or can no longer be."""
    note, made = at.note(job), job.kind == "score" or at.result(job).exists()
    if note is not None and note.key == at.key(job) and (note.final or (note.state == "done" and made)):
        return note
    if job.kind == "embed":
        for before in (notes[one] for one in job.after if notes[one].state != "done"):
            return at.leave(job, before.state, before.why, final=before.final)
    if at.over and job.kind != "score":
        return at.leave(job, "stopped", f"the budget was used before its turn{_seen(at, job)}")
    return None


def _seen(at: Comparison, job: Job) -> str:
    images = run_progress(at.run(job))["images"] if job.kind == "train" else None
    return f" ({images:,} of {at.plan.images:,} images seen)" if images else ""


def _apart(at: Comparison, job: Job) -> Note:
    """Do a job in a process of its own, which a little after the budget is ended."""
    at.file("jobs", job, ".json").unlink(missing_ok=True)
    process = multiprocessing.get_context("spawn").Process(target=_work, args=(at, job))
    process.start()
    left = inf if job.kind == "score" else at.deadline + GRACE_SECONDS - time.time()
    process.join(min(max(left, 0), threading.TIMEOUT_MAX))
    process.terminate()
    process.join()
    return at.note(job) or died(at, job, process.exitcode or 0)


def died(at: Comparison, job: Job, code: int) -> Note:
    """The note of a process that ended without one."""
    if at.over and job.kind != "score":
        return at.leave(job, "stopped", "the budget was used while it was under way")
    how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
    return at.leave(job, "failed", f"its process {how}: see {at.file('logs', job, '.log')}")


def _work(at: Comparison, job: Job) -> None:
    """A worker process: one job, its words in a file."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    log = at.file("logs", job, ".log")
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as stream:
        os.dup2(stream.fileno(), sys.stdout.fileno())
        os.dup2(stream.fileno(), sys.stderr.fileno())
    try:
        perform(at, job)
    except KeyboardInterrupt:  # Ctrl-C or SIGTERM: the training is saved, and no note is left
        sys.exit(130)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)
