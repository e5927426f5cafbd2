"""One process at a time writes a run: a file in its folder names the owner.

The lock (``flock``) ends with its process, however that ends, so that a run that was killed is taken over at
once. Where the system has none (Windows) runs are not locked.
"""

import os
import socket
import stat
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from derender.settings import Settings
from derender.storage.bounded import parse_json
from derender.training.distributed import this_rank_writes

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
        try:
            if not stat.S_ISREG(os.fstat(handle).st_mode):
                raise ValueError(f"{file} is no regular file: delete it")
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                lives = False
            except OSError:
                lives = True
            owner = None
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
                    return handle
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)
