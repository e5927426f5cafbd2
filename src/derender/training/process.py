"""The process of a run: its lock, Ctrl-C and SIGTERM, torch's deterministic operators, memory that is freed.

One process at a time writes a run. Its lock ends with the process, however that ends, so that a run that was
killed is taken over at once.
"""

import ctypes
import os
import shutil
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock, Timeout

from derender.training.distributed import this_rank_writes

_TRIM_THRESHOLD, _MMAP_THRESHOLD, _MMAP_MAX = -1, -3, -4  # numbers of mallopt's parameters in malloc.h
_KEEP = {_TRIM_THRESHOLD: -1, _MMAP_MAX: 0}  # never trim; no blocks of their own mapping
_USUAL = {_TRIM_THRESHOLD: 64 << 20, _MMAP_THRESHOLD: 32 << 20, _MMAP_MAX: 65_536}  # where glibc's settle
_kept = threading.Lock()

LOCK_FILE = "run.lock"


class TrainingInterrupted(KeyboardInterrupt):
    """Ctrl-C or SIGTERM during training; the run was saved first and can be resumed."""


@contextmanager
def stop_on_signal() -> Iterator[threading.Event]:
    """Turn the first Ctrl-C or SIGTERM, in the main thread, into an event; a second one ends the program."""
    stop = threading.Event()

    def note(number: int, frame: object) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    main = threading.current_thread() is threading.main_thread()
    signals = (signal.SIGINT, signal.SIGTERM) if main else ()
    previous = {number: signal.signal(number, note) for number in signals}
    try:
        yield stop
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextmanager
def evaluating(model: Any) -> Iterator[None]:
    """The model in evaluation mode within the block, then as it was; meanwhile `freed_memory_kept`."""
    was_training, device = model.training, next(model.parameters(), torch.empty(0)).device
    model.eval()
    try:
        with freed_memory_kept(device):
            yield
    finally:
        model.train(was_training)


@contextmanager
def deterministic_algorithms(deterministic: bool) -> Iterator[None]:
    """Within the block torch uses deterministic operators (an error names one that has none), or need not."""
    before = torch.are_deterministic_algorithms_enabled()
    warn_only = torch.is_deterministic_algorithms_warn_only_enabled()
    if deterministic:
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # on CUDA torch refuses without
    torch.use_deterministic_algorithms(deterministic)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before, warn_only=warn_only)


@contextmanager
def freed_memory_kept(device: torch.device) -> Iterator[bool]:
    """Have glibc reuse freed memory instead of returning it, on a CPU; gives whether that begins here.

    glibc returns every freed large block, and the system fills it with zeros when it is needed again: up to a
    third of a training step, two fifths of an embedding. Nothing changes for other allocators, on other
    devices and within another such block.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform.startswith("linux") else None
    if mallopt is None or device.type != "cpu" or not _kept.acquire(blocking=False):
        yield False
        return
    try:
        yield min(mallopt(parameter, value) for parameter, value in _KEEP.items()) == 1
    finally:
        for parameter, value in _USUAL.items():
            mallopt(parameter, value)
        _kept.release()


@contextmanager
def locked(run: Path) -> Iterator[None]:
    """Keep other processes from writing a run within the block; a ValueError where one does.

    What is called within the block may lock the run again. A folder that is made for the lock goes with it if
    nothing else was put there.
    """
    if not this_rank_writes():
        yield
        return
    made, file = not run.exists(), run.absolute() / LOCK_FILE
    lock = FileLock(file, timeout=0, is_singleton=True)
    try:
        run.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except (Timeout, FileNotFoundError, FileExistsError) as error:  # the last two: it has just gone again
        broken = run.is_symlink() and not run.exists()
        if run.is_file() or broken or not run.parent.is_dir():
            raise
        raise ValueError(f"{run} is being written by another process: wait for it, or end it") from error
    try:
        yield
    finally:
        with suppress(OSError):  # a folder that has gone hides no error of the block
            if made and [entry.name for entry in run.iterdir()] in ([], [LOCK_FILE]):
                shutil.rmtree(run, ignore_errors=True)  # before another can hold its lock
        lock.release()
