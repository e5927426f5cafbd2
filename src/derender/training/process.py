"""The process of a run: its lock, Ctrl-C and SIGTERM, torch's deterministic operators, memory that is freed.

One process at a time writes a run: a file in its folder names the owner. The lock (``flock``) ends with its
process, however that ends, so that a run that was killed is taken over at once. Where the system has none
(Windows) runs are not locked.
"""

import ctypes
import os
import signal
import socket
import stat
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import torch

from derender.settings import Settings
from derender.storage.bounded import parse_json
from derender.training.distributed import this_rank_writes

_TRIM_THRESHOLD, _MMAP_MAX = -1, -4  # numbers of mallopt's parameters in glibc's malloc.h
_KEEP = {_TRIM_THRESHOLD: -1, _MMAP_MAX: 0}  # never trim; no blocks of their own mapping
_DEFAULT = {_TRIM_THRESHOLD: 128 * 1024, _MMAP_MAX: 65_536}


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
    """The model in evaluation mode within the block, and afterwards as it was."""
    was_training = model.training
    model.eval()
    try:
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
def freed_memory_kept() -> Iterator[bool]:
    """Have glibc reuse freed memory instead of returning it; gives whether it could be configured so.

    glibc returns every freed large block, and the system fills it with zeros when it is needed again: up to a
    third of a training step on a CPU. Other allocators, and memory of other devices, stay as they are.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform.startswith("linux") else None
    if mallopt is None:
        yield False
        return
    accepted = [mallopt(parameter, value) for parameter, value in _KEEP.items()]
    try:
        yield all(accepted)
    finally:
        for parameter, value in _DEFAULT.items():
            mallopt(parameter, value)


try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

LOCK_FILE = "run.lock"
_OWNER_BYTES = 4096
_held: dict[Path, int] = {}
"""Locks of this process, and the threads that have them: what one of them calls may lock again."""


class _Owner(Settings):
    pid: int
    host: str


@contextmanager
def locked(run: Path) -> Iterator[None]:
    """Keep other processes from writing a run within the block; a ValueError names the one that does.

    A folder that is made for the lock goes with it if nothing else was put there.
    """
    file = run.absolute() / LOCK_FILE
    if fcntl is None or not this_rank_writes() or _held.get(file) == threading.get_ident():
        yield
        return
    made = not run.exists()
    handle = _acquired(file)
    _held[file] = threading.get_ident()
    try:
        yield
    finally:
        del _held[file]
        file.unlink(missing_ok=True)
        os.close(handle)
        if made:
            with suppress(OSError):  # it holds a run
                run.rmdir()


def _acquired(file: Path) -> int:
    """The open lock file, which is ours and says so."""
    assert fcntl is not None
    own = _Owner(pid=os.getpid(), host=socket.gethostname())
    while True:
        file.parent.mkdir(parents=True, exist_ok=True)
        try:
            handle = os.open(file, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o644)
        except FileNotFoundError:  # its last owner has just removed the folder
            continue
        with ExitStack() as undone:
            undone.callback(os.close, handle)
            if not stat.S_ISREG(os.fstat(handle).st_mode):
                raise ValueError(f"{file} is no regular file: delete it")
            lives, owner = False, None
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                lives = True
            with suppress(ValueError):  # not written yet
                owner = parse_json(os.pread(handle, _OWNER_BYTES, 0), _Owner)
            if lives or (owner is not None and owner.host != own.host):
                who = "another process" if owner is None else f"process {owner.pid} on {owner.host}"
                gone = "" if lives else f"; if that has ended, delete {file}"
                raise ValueError(f"{file.parent} is being written by {who}: wait for it, or end it{gone}")
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(handle), file.lstat()):  # not removed by its last owner
                    os.ftruncate(handle, 0)
                    os.pwrite(handle, own.model_dump_json().encode(), 0)
                    undone.pop_all()
                    return handle
