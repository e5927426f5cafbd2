"""One attempt of a command, in a process of its own, and its end: a signal, a full disk or an exception.

Leaves out what is attempted (commands.py) and how often (kills.py).
"""

import ctypes
import importlib
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from apart import ended, start, waited
from killing.commands import Command

from derender.cli import main

SIGNALS = {"SIGKILL": signal.SIGKILL, "SIGTERM": signal.SIGTERM, "Ctrl-C": signal.SIGINT}
PRELOADED = {
    *("derender", "torch", "lightning_fabric", "tensorboard"),
    *("matplotlib", "sklearn", "scipy", "numba"),
}
INJECTED = 86
"""The exit code of a process that an injected exception ended."""


def run_child(
    arguments: list[str],
    log: Path,
    *,
    file_limit: int | None = None,
    raise_after: float | None = None,
    record: Path | None = None,
    hold: tuple[int, int] | None = None,
) -> int:
    """Start the command in a process of its own; gives its number.

    Args:
        arguments: of the command.
        log: takes what it says.
        file_limit: no file may be longer, in bytes.
        raise_after: seconds after which an exception is raised in it.
        record: takes the names of the modules it has imported in the end, and how many files it has written.
        hold: stops itself in the midst of writing a file: in the writing of this number, after so many calls.
    """

    def work() -> int:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
        if file_limit is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (file_limit, file_limit))
        if raise_after is not None:
            main_thread = ctypes.c_ulong(threading.main_thread().ident or 0)
            inject = ctypes.pythonapi.PyThreadState_SetAsyncExc
            timer = threading.Timer(raise_after, inject, (main_thread, ctypes.py_object(Injected)))
            timer.daemon = True
            timer.start()
        writes = Writes(hold)
        sys.addaudithook(writes.seen)
        try:
            code = main(arguments)
        except Injected:
            return INJECTED
        if record is not None:
            record.write_text("\n".join((str(writes.begun), *sys.modules)))
        return code

    return start(work, log)


def preload(modules: Path) -> None:
    """Import what a command needed: later processes begin with it, and are killed at work."""
    for name in modules.read_text().splitlines()[1:]:
        if name.split(".")[0] in PRELOADED:
            importlib.import_module(name)


class Writes:
    """Counts files and folders written under another name, and stops the process in the midst of one.

    Attributes:
        begun: how many there were.
        hold: the number of the one to stop in, and after how many calls; at the latest when it gets its name.
    """

    def __init__(self, hold: tuple[int, int] | None = None):
        self.begun, self.calls, self.hold, self.midst = 0, 0, hold, False

    def seen(self, event: str, _: object) -> None:
        """Hears of every file that is touched."""
        if event in ("tempfile.mkstemp", "tempfile.mkdtemp"):
            self.begun += 1
            if self.hold is not None and self.begun == self.hold[0]:
                self.midst = True
                sys.setprofile(self.called)
        elif event == "os.rename" and self.midst:
            self.stop()

    def called(self, frame: object, event: str, _: object) -> None:
        """Hears of every call within the writing."""
        if event in ("call", "c_call"):
            self.calls += 1
            if self.hold is not None and self.calls >= self.hold[1]:
                self.stop()

    def stop(self) -> None:
        if self.midst:
            self.midst = False
            sys.setprofile(None)
            os.kill(os.getpid(), signal.SIGSTOP)


class Injected(Exception):
    """Raised at a random moment."""


@contextmanager
def small_disk(megabytes: int, mount: bool) -> Iterator[tuple[Path, bool]]:
    """A folder, on a file system of this size where one may be mounted."""
    folder = Path(tempfile.mkdtemp(prefix="derender-kills-"))
    command = ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "none", str(folder)]
    mounted = (
        mount
        and sys.platform == "linux"
        and os.geteuid() == 0
        and subprocess.run(command, capture_output=True).returncode == 0
    )
    try:
        yield folder, mounted
    finally:
        if mounted:
            subprocess.run(["umount", "-l", str(folder)], check=False)
        shutil.rmtree(folder, ignore_errors=True)


def being_written(folder: Path) -> bool:
    """Whether a file or folder stands there under the name it has while it is written."""
    return any(entry.name.startswith(".") or entry.name == "writing.parquet" for entry in walk(folder))


def walk(folder: Path) -> Iterator[os.DirEntry[str]]:
    try:
        for entry in os.scandir(folder):
            yield entry
            if entry.is_dir(follow_symlinks=False) and not entry.name.startswith("."):
                yield from walk(Path(entry.path))
    except FileNotFoundError:
        return


def stopped(child: int) -> bool:
    """Whether it has stopped itself."""
    status = Path(f"/proc/{child}/stat").read_text()
    return status.rpartition(")")[2].split()[0] == "T"


@dataclass
class Place:
    """Where a command is killed.

    Attributes:
        disk: the folder that may be a small disk of its own.
        mounted: whether it is one.
        log: what the command said last; not on that disk.
        numbers: draws causes' moments.
        seconds: how long the command takes undisturbed.
        bytes: what it leaves undisturbed.
        writes: how many files it writes undisturbed.
    """

    disk: Path
    mounted: bool
    log: Path
    numbers: random.Random
    seconds: float = 0.0
    bytes: int = 0
    writes: int = 0


def attempt(command: Command, folder: Path, place: Place, cause: str) -> tuple[int, bool]:
    """Run the command once and end it by this cause; gives the exit code, and whether it was writing."""
    numbers, filler = place.numbers, place.disk / "filler"
    moment, at_write = numbers.uniform(0, place.seconds), numbers.random() < 0.5
    limit = None
    if cause == "full disk" and place.mounted:
        fill(filler, leave=numbers.randrange(place.bytes))
    elif cause == "full disk":
        limit = numbers.randrange(1, 60_000)
    raise_after = moment if cause == "exception" else None
    hold = None
    if cause in SIGNALS and at_write and command.quick:
        hold = numbers.randint(1, place.writes), round(10 ** numbers.uniform(0.5, 3))
    child = run_child(
        command.arguments(folder), place.log, file_limit=limit, raise_after=raise_after, hold=hold
    )
    code, writing = None, False
    if cause in SIGNALS:
        if hold is None:
            code = waited(child, moment)
        if code is None and at_write:
            code = waited(child, 120, lambda: stopped(child) if hold else being_written(folder))
            time.sleep(0 if hold else numbers.uniform(0, 0.003))
        writing = code is None and being_written(folder)
        if code is None:
            os.kill(child, SIGNALS[cause])
            os.kill(child, signal.SIGCONT)
    code = waited(child, 600) if code is None else code
    filler.unlink(missing_ok=True)
    if code is None:
        ended(child)
        raise TimeoutError(f"{command.name} did not end within 10 minutes of {cause}")
    return code, writing


def fill(file: Path, leave: int) -> None:
    """Take all room there is on a small disk but for so many bytes."""
    room = shutil.disk_usage(file.parent).free - leave
    if room > 0:
        with file.open("wb") as stream:
            os.posix_fallocate(stream.fileno(), 0, room)
