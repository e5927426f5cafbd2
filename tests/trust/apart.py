"""A function in a process of its own, and waiting for its end: shared by the scripts of this folder."""

import os
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path


def start(work: Callable[[], int], log: Path, *, failed: int = 1) -> int:
    """Fork a process whose output goes to ``log`` and whose exit code is what ``work`` returns.

    An exception ends it with its traceback in the log and the exit code ``failed``. Gives its number.
    """
    stream = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    child = os.fork()
    if child:
        os.close(stream)
        return child
    code = failed
    try:
        os.dup2(stream, 1)
        os.dup2(stream, 2)
        code = int(work())
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def waited(child: int, seconds: float) -> int | str | None:
    """Wait for a child so many seconds: its exit code, "stopped" if it has stopped, None if it still runs."""
    until = time.monotonic() + seconds
    while True:
        done, status = os.waitpid(child, os.WNOHANG | os.WUNTRACED)
        if done:
            return "stopped" if os.WIFSTOPPED(status) else os.waitstatus_to_exitcode(status)
        if time.monotonic() >= until:
            return None
        time.sleep(0.002)
