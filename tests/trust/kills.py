"""Kills training, embedding and comparing at random moments, resumes each time, and compares what comes out.

    python tests/trust/kills.py --kills 30 --seed 0

Each attempt is a process of its own that runs one command as a user would. It is ended by SIGKILL, SIGTERM,
Ctrl-C, a full disk or an exception, at a moment drawn at random. Half of the signals are aimed: the process
stops itself in the midst of writing a file drawn at random, and is ended there. What lies on disk is checked
after each, and the command is given again until it comes through; the result must then be that of an
undisturbed run, bit for bit. The disk is a small tmpfs, filled up, where one may be mounted (root); elsewhere
a limit on the size of files.
"""

import argparse
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
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from apart import start, waited
from killing.commands import Command, compare_command, embed_command, train_command

from derender.cli import main
from derender.features import embedding as embedding_module

SIGNALS = {"SIGKILL": signal.SIGKILL, "SIGTERM": signal.SIGTERM, "Ctrl-C": signal.SIGINT}
CAUSES = (*SIGNALS, "full disk", "exception")
CAME_THROUGH, INJECTED = 0, 86
ENDINGS = {"SIGKILL": (-9,), "SIGTERM": (-15, 130), "Ctrl-C": (130,), "full disk": (2,)}
ENDINGS["exception"] = (INJECTED, 2)
"""Exit codes of an attempt that was ended by each cause; 0 if it came through before or in spite of it."""

PRELOADED = {"derender", "torch", "lightning_fabric", "tensorboard"}
PRELOADED |= {"matplotlib", "sklearn", "scipy", "numba"}
DISK_MEGABYTES = 200


class Injected(Exception):
    """Raised at a random moment."""


class Writes:
    """Counts files and folders that are begun under another name, and stops the process in the midst of one.

    ``hold`` is the number of the one to stop in, and after how many calls; at the latest at its renaming.
    """

    def __init__(self, hold: tuple[int, int] | None):
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
        self.calls += event in ("call", "c_call")
        if self.midst and self.hold is not None and self.calls >= self.hold[1]:
            self.stop()

    def stop(self) -> None:
        self.midst = False
        sys.setprofile(None)
        os.kill(os.getpid(), signal.SIGSTOP)


@dataclass
class Trial:
    """One command, where it is killed, and what happened.

    Attributes:
        disk: the folder that may be a small disk of its own; ``mounted`` says whether it is one.
        log: what the command said last; not on that disk.
        numbers: draws causes' moments.
        seconds, bytes, writes: how long the command takes undisturbed, what it leaves and writes.
        kills: by cause, of attempts that were ended before they came through.
        writing: how many of them while a file was being written.
        rounds: how many times the command was brought to its end.
        survived: how many of these gave the undisturbed result.
        faults: sentences on what went wrong.
    """

    command: Command
    disk: Path
    mounted: bool
    log: Path
    numbers: random.Random
    seconds: float = 0.0
    bytes: int = 0
    writes: int = 0
    kills: Counter[str] = field(default_factory=Counter)
    writing: int = 0
    rounds: int = 0
    survived: int = 0
    faults: list[str] = field(default_factory=list)

    def child(
        self, folder: Path, *, limit: int | None = None, raise_after: float | None = None,
        hold: tuple[int, int] | None = None, record: bool = False,
    ) -> int:  # fmt: skip
        """Start the command in a process of its own; gives its number. Can record writes and modules."""

        def work() -> int:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            if limit is not None:
                signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
            if raise_after is not None:
                thread = ctypes.c_ulong(threading.main_thread().ident or 0)
                inject = ctypes.pythonapi.PyThreadState_SetAsyncExc
                timer = threading.Timer(raise_after, inject, (thread, ctypes.py_object(Injected)))
                timer.daemon = True
                timer.start()
            writes = Writes(hold)
            sys.addaudithook(writes.seen)
            try:
                code = main(self.command.arguments(folder))
            except Injected:
                return INJECTED
            if record:
                self.log.with_suffix(".record").write_text("\n".join((str(writes.begun), *sys.modules)))
            return code

        return start(work, self.log)

    def undisturbed(self, folder: Path) -> dict[str, bytes]:
        """The result of an undisturbed run; notes time and bytes it takes, and imports what it did.

        Later processes begin with those modules, and are killed at work.
        """
        folder.mkdir()
        began = time.monotonic()
        if waited(self.child(folder, record=True), 900) != CAME_THROUGH:
            raise RuntimeError(f"{self.command.name} does not come through:\n{self.log.read_text()}")
        self.seconds = time.monotonic() - began
        self.bytes = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
        writes, *modules = self.log.with_suffix(".record").read_text().splitlines()
        self.writes = int(writes)
        for name in modules:
            if name.split(".")[0] in PRELOADED:
                importlib.import_module(name)
        result = self.command.result(folder)
        shutil.rmtree(folder)
        return result

    def attempt(self, folder: Path, cause: str) -> int:
        """Run the command once and end it by this cause; gives the exit code."""
        draw, filler = self.numbers, self.disk / "filler"
        moment, how = draw.uniform(0, self.seconds), {}
        if cause == "full disk" and self.mounted:
            room = shutil.disk_usage(self.disk).free - draw.randrange(self.bytes)
            with filler.open("wb") as stream:
                os.posix_fallocate(stream.fileno(), 0, max(1, room))
        elif cause == "full disk":
            how["limit"] = draw.randrange(1, 60_000)
        elif cause == "exception":
            how["raise_after"] = moment
        elif cause in SIGNALS and draw.random() < 0.5:
            how["hold"] = draw.randint(1, self.writes), round(10 ** draw.uniform(0.5, 3))
        child = self.child(folder, **how)
        code = waited(child, moment if cause in SIGNALS and not how else 600)
        if code in (None, "stopped") and cause in SIGNALS:
            self.writing += code == "stopped"
            os.kill(child, SIGNALS[cause])
            os.kill(child, signal.SIGCONT)
            code = waited(child, 600)
        filler.unlink(missing_ok=True)
        if not isinstance(code, int):
            os.kill(child, signal.SIGKILL)
            raise TimeoutError(f"{self.command.name} did not end within 10 minutes of {cause}")
        return code

    def check(self, folder: Path, cause: str, code: int) -> None:
        """After a kill: an ending as promised, no traceback, and nothing half-written on disk."""
        said = self.log.read_text(errors="replace")
        if code not in ENDINGS.get(cause, ()) or "Traceback" in said:
            self.faults.append(f"{self.command.name} ended by {cause} with exit code {code}: {said[-1500:]}")
        try:
            self.command.sound(folder)
        except (ValueError, OSError) as problem:
            self.faults.append(f"after {cause} {self.command.name} left something half-written: {problem}")

    def kill(self, kills: int) -> None:
        """Kill the command so many times in all, from as many beginnings as that takes."""
        self.undisturbed(self.disk / "first")
        wanted = self.undisturbed(self.disk / "whole")
        while (done := self.kills.total()) < kills:
            folder, code = self.disk / f"round{self.rounds}", -1
            folder.mkdir()
            self.rounds += 1
            while code != CAME_THROUGH and done <= kills:
                cause, began = CAUSES[done % len(CAUSES)] if done < kills else "nothing", time.monotonic()
                code = self.attempt(folder, cause)
                if code == CAME_THROUGH:  # it takes no longer than that: draw earlier moments
                    self.seconds = min(self.seconds, time.monotonic() - began)
                    continue
                self.kills[cause] += 1
                done += 1
                self.check(folder, cause, code)
            if code == CAME_THROUGH and self.command.result(folder) == wanted:
                self.survived += 1
            else:
                self.faults.append(f"round {self.rounds} of {self.command.name} ended otherwise")
            shutil.rmtree(folder)
            self.tell()

    def tell(self) -> None:
        by_cause = ", ".join(f"{cause} {count}" for cause, count in sorted(self.kills.items()))
        print(
            f"{self.command.name}: {self.kills.total()} kills ({by_cause}), {self.writing} while writing; "
            f"{self.survived} of {self.rounds} runs ended bit-identical to the undisturbed one; "
            f"{len(self.faults)} faults",
            flush=True,
        )


@contextmanager
def small_disk(mount: bool) -> Iterator[tuple[Path, bool]]:
    """A folder, on a small file system of its own where one may be mounted, and whether it is."""
    with tempfile.TemporaryDirectory(prefix="derender-kills-") as folder:
        command = ["mount", "-t", "tmpfs", "-o", f"size={DISK_MEGABYTES}m", "none", folder]
        allowed = mount and sys.platform == "linux" and os.geteuid() == 0
        mounted = allowed and subprocess.run(command, capture_output=True).returncode == 0
        try:
            yield Path(folder), mounted
        finally:
            if mounted:
                subprocess.run(["umount", "-l", folder], check=False)


def run(given: argparse.Namespace) -> int:
    """The script."""
    embedding_module.PART_ROWS = 8
    faults = []
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        commands = {
            "train": lambda: train_command(place, given.images),
            "embed": lambda: embed_command(place, given.model, given.pictures),
            "compare": lambda: compare_command(place),
        }
        for name in given.what.split(","):
            with small_disk(not given.no_mount) as (disk, mounted):
                trial = Trial(commands[name](), disk, mounted, place / "log", random.Random(given.seed))
                trial.kill(given.kills)
            faults += trial.faults
    for fault in faults:
        print(f"  {fault}")
    return 1 if faults else 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=30, help="of each command")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--images", type=int, default=96, help="images seen in a training")
    parser.add_argument("--pictures", type=int, default=120, help="embedded")
    parser.add_argument("--model", type=Path, default=Path("rendered-faces-64"), help="that embeds")
    parser.add_argument("--no-mount", action="store_true", help="limit the size of files instead")
    parser.add_argument("--what", default="train,embed,compare")
    sys.exit(run(parser.parse_args()))
