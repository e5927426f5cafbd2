"""A function in a process of its own, and waiting for its end: shared by the scripts of this folder."""

import importlib.util
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

HERE = Path(__file__).parent


def script(name: str) -> ModuleType:
    """A script of this folder as a module."""
    spec = importlib.util.spec_from_file_location(Path(name).stem, HERE / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = sys.modules[Path(name).stem] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def start(work: Callable[[], int], log: Path, *, failed: int = 1) -> int:
    """Fork a process whose output goes to ``log`` and whose exit code is what ``work`` returns.

    An exception ends it with its traceback in the log and the exit code ``failed``. Gives its number.
    """
    log.write_text("")
    child = os.fork()
    if child:
        return child
    code = failed
    try:
        stream = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(stream, 1)
        os.dup2(stream, 2)
        code = int(work())
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def waited(child: int, seconds: float, stop: Callable[[], bool] = lambda: False) -> int | None:
    """Wait for a child's end, so many seconds, or ``stop``; its exit code, or None while it runs."""
    until = time.monotonic() + seconds
    while time.monotonic() < until and not stop():
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.002)
    return None


def ended(child: int, group: bool = False) -> None:
    """End a child, or the group that it leads, by force."""
    (os.killpg if group else os.kill)(child, signal.SIGKILL)
    os.waitpid(child, 0)
