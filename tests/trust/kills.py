"""Kills training, embedding and comparing at random moments, resumes each time, and compares what comes out.

    python tests/trust/kills.py --kills 30 --seed 0

Each attempt is a process of its own that runs one command as a user would. It is ended by SIGKILL, SIGTERM,
Ctrl-C, a full disk or an exception, at a moment drawn at random: half of the moments anywhere in the command,
half just when a file is being written. A comparison writes faster than one can look: it stops itself in the
midst of a file drawn at random, and is ended there. What lies on disk is checked after each, and the command
is given again until it comes through; the result must then be that of an undisturbed run, bit for bit. The
disk is a small tmpfs, filled up, where one may be mounted (root); elsewhere a limit on the size of files.
"""

import argparse
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from apart import waited
from killing.attempts import INJECTED, Place, attempt, preload, run_child, small_disk
from killing.commands import (
    Command,
    compare_command,
    embed_command,
    made_pictures,
    made_table,
    train_command,
)

from derender.features import embedding as embedding_module

CAUSES = ("SIGKILL", "SIGTERM", "Ctrl-C", "full disk", "exception")
CAME_THROUGH = 0
ENDINGS = {
    "SIGKILL": (-9,),
    "SIGTERM": (-15, 130),
    "Ctrl-C": (130,),
    "full disk": (2,),
    "exception": (INJECTED, 2),
}
"""Exit codes of an attempt that was ended by each cause; 0 if it came through before or in spite of it."""


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


def undisturbed(command: Command, folder: Path, place: Place) -> dict[str, bytes]:
    """The result of a run nobody disturbs; notes how long it takes and what it leaves."""
    folder.mkdir(parents=True)
    began = time.monotonic()
    record = place.log.with_suffix(".modules")
    code = waited(run_child(command.arguments(folder), place.log, record=record), 900)
    if code != CAME_THROUGH:
        raise RuntimeError(f"{command.name} does not come through undisturbed:\n{place.log.read_text()}")
    place.seconds = time.monotonic() - began
    place.writes = int(record.read_text().splitlines()[0])
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
            "embed": lambda: embed_command(given.model, made_pictures(Path(place) / "more", given.pictures)),
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
    parser.add_argument("--images", type=int, default=96, help="images seen in a training")
    parser.add_argument("--pictures", type=int, default=120, help="embedded")
    parser.add_argument("--model", type=Path, default=Path("rendered-faces-64"), help="that embeds")
    parser.add_argument("--no-mount", action="store_true", help="limit the size of files instead")
    parser.add_argument("--what", default="train,embed,compare")
    sys.exit(run(parser.parse_args()))
