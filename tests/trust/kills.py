"""Kills training, embedding and comparing at random moments, resumes each time, and compares what comes out.

    python tests/trust/kills.py --kills 30 --seed 0

Each attempt is a process of its own that runs one command as a user would. It is ended by SIGKILL, SIGTERM,
Ctrl-C, a full disk or an exception, at a moment drawn at random: half of the moments anywhere in the command,
half just when a file is being written. What lies on disk is checked after each, and the command is given
again until it comes through; the result must then be that of an undisturbed run, bit for bit. The disk is a
small tmpfs that is filled up where one may be mounted (root); elsewhere a limit on the size of files.
"""

import argparse
import ctypes
import importlib
import json
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
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image
from safetensors.torch import load_file

from derender.cli import main
from derender.features import FeatureTable
from derender.features import embedding as embedding_module
from derender.model import load
from derender.whole import check_seal

SIGNALS = {"SIGKILL": signal.SIGKILL, "SIGTERM": signal.SIGTERM, "Ctrl-C": signal.SIGINT}
CAUSES = ("SIGKILL", "SIGTERM", "Ctrl-C", "full disk", "exception")
CAME_THROUGH, BAD_INPUT, STOPPED = 0, 2, 130
PRELOADED = (
    "derender",
    "torch",
    "lightning_fabric",
    "tensorboard",
    "matplotlib",
    "sklearn",
    "scipy",
    "numba",
)
INJECTED = 86
"""The exit code of a process that an injected exception ended."""

TRAINING = (
    "preset=small",
    "image_size=32",
    "width=8",
    "light_width=4",
    "batch_size=8",
    "self_features_steps=2",
)
EVERY = (
    "checkpoint_every=24",
    "validate_every=48",
    "sample_every=48",
    "deterministic=true",
    "whitening.pictures=8",
)


@dataclass(frozen=True)
class Command:
    """A command that can be killed.

    Attributes:
        name: what it is called in the figures.
        arguments: of the first attempt and of later ones, given the folder it works in.
        sound: raises unless what lies in the folder is whole.
        result: what must be the same in the end, by name, as bytes.
    """

    name: str
    arguments: Callable[[Path], list[str]]
    sound: Callable[[Path], None]
    result: Callable[[Path], dict[str, bytes]]


@dataclass
class Figures:
    """What happened.

    Attributes:
        kills: by cause, of attempts that were ended before they came through.
        writing: how many of them while a file was being written.
        rounds: how many times a command was brought to its end.
        survived: how many of these gave the undisturbed result.
        faults: sentences on what went wrong.
    """

    kills: Counter[str] = field(default_factory=Counter)
    writing: int = 0
    rounds: int = 0
    survived: int = 0
    faults: list[str] = field(default_factory=list)


def made_pictures(folder: Path, count: int = 40, size: int = 32) -> Path:
    """A folder of smooth random pictures, a tenth of them broken."""
    folder.mkdir(parents=True)
    random_numbers = np.random.default_rng(0)
    for number in range(count):
        small = Image.fromarray(random_numbers.integers(0, 256, (4, 4, 3), dtype=np.uint8))
        small.resize((size, size)).save(folder / f"{number:03d}.png")
    for number in range(count // 10):
        (folder / f"broken{number}.png").write_bytes(b"no picture")
    return folder


def made_table(file: Path, seed: int, rows: int = 150) -> Path:
    """Features with an identity that one factor shows."""
    random_numbers = np.random.default_rng(seed)
    identity = np.arange(rows) % 6
    geometry = random_numbers.normal(size=(rows, 8)) + 2 * np.eye(8)[identity]
    factors = {"geometry": geometry, "albedo": random_numbers.normal(size=(rows, 8))}
    names = tuple(f"{row}.png" for row in range(rows))
    labels = {"identity": np.array([f"person {value}" for value in identity])}
    return FeatureTable(names, factors, labels).write(file)


def train_command(data: Path, images: int) -> Command:
    """Pre-training of a tiny model, with perceptual features, whitening and a report."""
    chosen = [text for setting in (*TRAINING[1:], *EVERY, f"images={images}") for text in ("--set", setting)]

    def arguments(folder: Path) -> list[str]:
        given = ["train", "--data", str(data), "--out", str(folder / "run"), "--device", "cpu"]
        resume = ["--resume"] if (folder / "run" / "config.yaml").exists() else []
        return [*given, "--preset", "small", *chosen, *resume]

    def sound(folder: Path) -> None:
        for place in ("last", "previous", "best"):
            if (folder / "run" / "checkpoints" / place).exists():
                check_seal(folder / "run" / "checkpoints" / place)
        if (folder / "run" / "model").exists():
            load(folder / "run" / "model")

    def result(folder: Path) -> dict[str, bytes]:
        run = folder / "run"
        files = [
            run / "checkpoints" / place / f"{name}.safetensors"
            for place in ("last", "best")
            for name in ("model", "optimiser")
        ]
        files += [
            run / "model" / "model.safetensors",
            run / "model" / "whitening.safetensors",
            run / "perceptual.safetensors",
        ]
        return {str(file.relative_to(run)): tensor_bytes(file) for file in files}

    return Command("train", arguments, sound, result)


def embed_command(model: Path, data: Path) -> Command:
    """Embedding of a folder; parts are small here, so that there are many."""

    def arguments(folder: Path) -> list[str]:
        given = ["embed", "--model", str(model), "--data", str(data), "--out", str(folder / "table.parquet")]
        return [
            *given,
            "--device",
            "cpu",
            "--batch-size",
            "4",
            *(["--force"] if (folder / "table.parquet").exists() else []),
        ]

    def sound(folder: Path) -> None:
        if (folder / "table.parquet").exists():
            FeatureTable.read(folder / "table.parquet")

    def result(folder: Path) -> dict[str, bytes]:
        table = FeatureTable.read(folder / "table.parquet")
        return {
            "file": "\n".join(table.files).encode(),
            **{name: value.tobytes() for name, value in table.factors.items()},
        }

    return Command("embed", arguments, sound, result)


def compare_command(tables: list[Path]) -> Command:
    """A comparison of two features that remembers what it has computed."""

    def arguments(folder: Path) -> list[str]:
        given = ["compare", "--table", "identity", "--resamples", "60", "--cache", str(folder / "cache")]
        named = [text for table in tables for text in ("--features", f"{table.stem}={table}")]
        return [
            *given,
            *named,
            "--json",
            str(folder / "scores.json"),
            "--markdown",
            str(folder / "scores.md"),
            "--force",
        ]

    def sound(folder: Path) -> None:
        if (folder / "scores.json").exists():
            json.loads((folder / "scores.json").read_text())

    def result(folder: Path) -> dict[str, bytes]:
        return {name: (folder / name).read_bytes() for name in ("scores.json", "scores.md")}

    return Command("compare", arguments, sound, result)


def tensor_bytes(file: Path) -> bytes:
    """Names and values of a safetensors file."""
    return b"".join(
        name.encode() + value.numpy().tobytes() for name, value in sorted(load_file(file).items())
    )


def run_child(
    arguments: list[str],
    log: Path,
    *,
    file_limit: int | None = None,
    raise_after: float | None = None,
    record: Path | None = None,
) -> int:
    """Start the command in a process of its own; gives its number.

    Args:
        arguments: of the command.
        log: takes what it says.
        file_limit: no file may be longer, in bytes.
        raise_after: seconds after which an exception is raised in it.
        record: takes the names of the modules it has imported in the end.
    """
    log.write_text("")
    child = os.fork()
    if child:
        return child
    code = 1
    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
        stream = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(stream, 1)
        os.dup2(stream, 2)
        if file_limit is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (file_limit, file_limit))
        if raise_after is not None:
            main_thread = ctypes.c_ulong(threading.main_thread().ident or 0)
            inject = ctypes.pythonapi.PyThreadState_SetAsyncExc
            timer = threading.Timer(raise_after, inject, (main_thread, ctypes.py_object(Injected)))
            timer.daemon = True
            timer.start()
        code = main(arguments)
        if record is not None:
            record.write_text("\n".join(sys.modules))
    except Injected:
        code = INJECTED
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def preload(modules: Path) -> None:
    """Import what a command needed: later processes begin with it, and are killed at work."""
    for name in modules.read_text().splitlines():
        if name.split(".")[0] in PRELOADED:
            importlib.import_module(name)


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


def waited(child: int, seconds: float, stop: Callable[[], bool]) -> int | None:
    """Wait for a child's end, so many seconds, or ``stop``; its exit code, or None while it runs."""
    until = time.monotonic() + seconds
    while time.monotonic() < until and not stop():
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.002)
    return None


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
    """

    disk: Path
    mounted: bool
    log: Path
    numbers: random.Random
    seconds: float = 0.0
    bytes: int = 0


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
    child = run_child(command.arguments(folder), place.log, file_limit=limit, raise_after=raise_after)
    code, writing = None, False
    if cause in SIGNALS:
        code = waited(child, moment, lambda: False)
        if code is None and at_write:
            code = waited(child, 120, lambda: being_written(folder))
            time.sleep(numbers.uniform(0, 0.003))
        writing = code is None and being_written(folder)
        if code is None:
            os.kill(child, SIGNALS[cause])
    code = waited(child, 600, lambda: False) if code is None else code
    filler.unlink(missing_ok=True)
    if code is None:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        raise TimeoutError(f"{command.name} did not end within 10 minutes of {cause}")
    return code, writing


def fill(file: Path, leave: int) -> None:
    """Take all room there is on a small disk but for so many bytes."""
    room = shutil.disk_usage(file.parent).free - leave
    if room > 0:
        with file.open("wb") as stream:
            os.posix_fallocate(stream.fileno(), 0, room)


ENDINGS = {
    "SIGKILL": (-9,),
    "SIGTERM": (-15, 130),
    "Ctrl-C": (130,),
    "full disk": (2,),
    "exception": (INJECTED, 2),
}
"""Exit codes of an attempt that was ended by each cause; 0 if it came through before or in spite of it."""


def undisturbed(command: Command, folder: Path, place: Place) -> dict[str, bytes]:
    """The result of a run nobody disturbs; notes how long it takes and what it leaves."""
    folder.mkdir(parents=True)
    began = time.monotonic()
    record = place.log.with_suffix(".modules")
    code = waited(run_child(command.arguments(folder), place.log, record=record), 900, lambda: False)
    if code != CAME_THROUGH:
        raise RuntimeError(f"{command.name} does not come through undisturbed:\n{place.log.read_text()}")
    place.seconds = time.monotonic() - began
    place.bytes = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    return command.result(folder)


def kill(command: Command, kills: int, seed: int, *, mount: bool, megabytes: int = 200) -> Figures:
    """Kill a command so many times in all, from as many beginnings as that takes."""
    figures, numbers = Figures(), random.Random(seed)
    with small_disk(megabytes, mount) as (disk, mounted), tempfile.TemporaryDirectory() as beside:
        place = Place(disk, mounted, Path(beside) / "log", numbers)
        undisturbed(command, disk / "first", place)
        preload(place.log.with_suffix(".modules"))
        wanted = undisturbed(command, disk / "whole", place)
        for name in ("first", "whole"):
            shutil.rmtree(disk / name)
        while sum(figures.kills.values()) < kills:
            folder = disk / f"round{figures.rounds}"
            folder.mkdir()
            figures.rounds += 1
            code = -1
            while code != CAME_THROUGH:
                done = sum(figures.kills.values())
                cause = CAUSES[done % len(CAUSES)] if done < kills else "nothing"
                began = time.monotonic()
                code, writing = attempt(command, folder, place, cause)
                if code == CAME_THROUGH:  # it takes no longer than that: draw earlier moments
                    place.seconds = min(place.seconds, time.monotonic() - began)
                    continue
                figures.kills[cause] += 1
                figures.writing += writing
                check(command, folder, place, cause, code, figures)
                if cause == "nothing":
                    break
            if code == CAME_THROUGH and command.result(folder) == wanted:
                figures.survived += 1
            else:
                figures.faults.append(f"round {figures.rounds} of {command.name} ended otherwise")
            shutil.rmtree(folder)
            tell(command.name, figures)
    return figures


def check(command: Command, folder: Path, place: Place, cause: str, code: int, figures: Figures) -> None:
    """After a kill: an ending as promised, no traceback, and nothing half-written on disk."""
    said = place.log.read_text(errors="replace")
    if code not in ENDINGS.get(cause, ()):
        figures.faults.append(f"{command.name} ended by {cause} with exit code {code}: {said[-600:]}")
    if "Traceback" in said:
        figures.faults.append(f"{command.name} ended by {cause} with a traceback: {said[-1500:]}")
    try:
        command.sound(folder)
    except (ValueError, OSError) as problem:
        figures.faults.append(f"after {cause} {command.name} left something half-written: {problem}")


def tell(name: str, figures: Figures) -> None:
    by_cause = ", ".join(f"{cause} {count}" for cause, count in sorted(figures.kills.items()))
    print(
        f"{name}: {sum(figures.kills.values())} kills ({by_cause}), {figures.writing} while writing; "
        f"{figures.survived} of {figures.rounds} runs ended bit-identical to the undisturbed one; "
        f"{len(figures.faults)} faults",
        flush=True,
    )


def run(given: argparse.Namespace) -> int:
    """The script."""
    embedding_module.PART_ROWS = 8
    faults = 0
    with tempfile.TemporaryDirectory() as place:
        data = made_pictures(Path(place) / "pictures")
        commands = {
            "train": lambda: train_command(data, given.images),
            "embed": lambda: embed_command(
                Path("rendered-faces-64"), made_pictures(Path(place) / "more", 120)
            ),
            "compare": lambda: compare_command(
                [
                    made_table(Path(place) / f"{name}.parquet", seed)
                    for seed, name in enumerate(("one", "two"))
                ]
            ),
        }
        for name in given.what.split(","):
            figures = kill(commands[name](), given.kills, given.seed, mount=not given.no_mount)
            faults += len(figures.faults)
            for fault in figures.faults:
                print(f"  {fault}", flush=True)
    return 1 if faults else 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=30, help="of each command")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--images", type=int, default=96, help="pictures seen in a training")
    parser.add_argument("--no-mount", action="store_true", help="limit the size of files instead")
    parser.add_argument("--what", default="train,embed,compare")
    sys.exit(run(parser.parse_args()))
