"""All jobs of a plan, each done once: a training with the features that need it, then scores.

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
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from math import inf
from multiprocessing import connection

import torch
from filelock import FileLock, Timeout

from derender.cli.console import duration, notice, progress_bar
from derender.cli.plan.jobs import Collapsed, Comparison, Job, Note, embed, jobs_of, score, train
from derender.training import TrainingInterrupted

GRACE_SECONDS = 30.0  # after the budget or Ctrl-C, for a worker to save
WORK = {"train": train, "embed": embed, "score": score}


def do_all(at: Comparison, workers: int = 1, minutes: float | None = None) -> dict[Job, Note]:
    """Do every job that is still needed until the budget of so many minutes is used; the note of each.

    Existing results are scored even after the budget: that ends a comparison with its tables.

    Raises:
        ValueError: another process works in the folder.
    """
    jobs, notes = jobs_of(at.plan), {}
    at.deadline = inf if minutes is None else time.time() + 60 * minutes
    lanes: dict[Job, list[Job]] = defaultdict(list)
    for job in jobs:
        lanes[job.after[0] if job.kind == "embed" and job.after else job].append(job)

    def do(lane: list[Job]) -> None:
        for job in lane:
            note, began = at.known(job), time.perf_counter()
            if note is None:
                note = perform(at, job) if workers == 1 else _apart(at, job)
                why = "" if note.state == "done" else f": {note.why}"
                took = duration(time.perf_counter() - began)
                notice(f"[{len(notes) + 1}/{len(jobs)}] {job.name}: {note.state}{why} ({took})")
            notes[job] = note

    at.path.mkdir(parents=True, exist_ok=True)
    if workers > 1:
        os.environ.setdefault("OMP_NUM_THREADS", str(max(1, torch.get_num_threads() // workers)))
    try:
        with FileLock(at.path / ".lock", timeout=0), ThreadPoolExecutor(workers) as pool:
            try:
                for kind in ("embed", "train", "score"):  # features that need no training come first
                    stage = [lane for lane in lanes.values() if lane[0].kind == kind]
                    list((map if workers == 1 else pool.map)(do, stage))
            finally:
                for process in multiprocessing.active_children():  # after Ctrl-C, which they got as well
                    process.join(GRACE_SECONDS)
                    process.terminate()
    except Timeout as error:
        raise ValueError(
            f"another derender compare works in {at.path}: wait for it, or choose another --out"
        ) from error
    except KeyboardInterrupt as stop:
        raise KeyboardInterrupt("stopped and saved; the same command goes on where it stopped") from stop
    return {job: notes[job] for job in jobs}


def perform(at: Comparison, job: Job) -> Note:
    """Do one job and leave its note, whatever happens in it."""
    try:
        with progress_bar(job.name, unit="steps" if job.kind == "score" else "images") as progress:
            return at.leave(job, facts=WORK[job.kind](at, job, progress))
    except TrainingInterrupted:
        if not at.over:
            raise
        return at.stopped(job)
    except Exception as error:
        with at.log(job) as stream:
            traceback.print_exc(file=stream)
        why, kind = " ".join(str(error).split()), type(error).__name__
        if not why or not isinstance(error, ValueError | OSError):
            why = f"{kind}: {why}".rstrip(": ")
        return at.leave(job, state="failed", why=why, final=isinstance(error, Collapsed))


def _apart(at: Comparison, job: Job) -> Note:
    """Do a job in a process of its own, which a little after the budget is ended."""
    at.file("jobs", job, ".json").unlink(missing_ok=True)
    process = multiprocessing.get_context("spawn").Process(target=_work, args=(at, job))
    process.start()
    endless = job.kind == "score" or at.deadline == inf
    process.join(None if endless else max(0.0, at.deadline + GRACE_SECONDS - time.time()))
    process.terminate()
    process.join()
    return at.note(job) or died(at, job, process.exitcode or 0)


def died(at: Comparison, job: Job, code: int) -> Note:
    """Leave the note of a process that ended without one."""
    if at.over and job.kind != "score":
        return at.stopped(job)
    how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
    why = f"its process {how}: see {at.file('logs', job, '.log')}"
    return at.leave(job, state="failed", why=why)


def _work(at: Comparison, job: Job) -> None:
    """A worker process: one job, its words in a file."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with at.log(job) as stream:
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
