"""Kills commands at random moments, gives them again, and compares what comes out with an undisturbed run.

    python tests/trust/kills.py --kills 30 --seed 0 --what train,refine

Each attempt is a process of its own. It is ended by SIGKILL, SIGTERM, Ctrl-C, a full disk or an exception, at
a moment drawn at random. Half of the signals are aimed: the process stops itself in the midst of writing a
file drawn at random, and is ended there. After each, whatever lies under its final name must be whole; the
command is given again until it comes through, and what it leaves must be that of an undisturbed run, bit for
bit. The disk is a small tmpfs, filled up, where one may be mounted (root); elsewhere a limit on file sizes.
"""

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
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from apart import start, waited
from material import left_in, made_material, made_model, made_runs

from derender.cli import main
from derender.features import embedding as embedding_module

SIGNALS = {"SIGKILL": signal.SIGKILL, "SIGTERM": signal.SIGTERM, "Ctrl-C": signal.SIGINT}
CAUSES = (*SIGNALS, "full disk", "exception")
CAME_THROUGH, INJECTED = 0, 86
ENDINGS = {"SIGKILL": (-9,), "SIGTERM": (-15, 130), "Ctrl-C": (130,), "full disk": (2, INJECTED)}
ENDINGS["exception"] = (INJECTED, 2)
"""Exit codes of an attempt that was ended by each cause; 0 if it came through before or in spite of it."""
FAILED = ": failed: "
"""Of a job of a plan, which goes on without it: counted as if it had ended the plan."""

PRELOADED = {"derender", "torch", "lightning_fabric", "tensorboard"}
PRELOADED |= {"matplotlib", "sklearn", "scipy", "numba"}
DISK_MEGABYTES = 400

LEARNT = ("image_size=32", "width=8", "light_width=4", "batch_size=8", "checkpoint_every=24")
LEARNT += ("self_features_steps=2", "validate_every=48", "sample_every=48", "images=96", "deterministic=true")
LEARNS = " ".join(f"--set {one}" for one in (*LEARNT, "whitening.pictures=8"))
RUN = ("run", "config.yaml", "--resume")
MADE = "--data DATA --model MODEL --device cpu"
SCORED = "--resamples 60 --cache OUT/cache --markdown OUT/scores.md"
TABLES = f"--features one=ONE --features two=TWO {SCORED}"
FEW = "--set images=16 --set fitted=8 --set fit_steps=2 --set whitening.pictures=8"
LABELS = "--label class --set perceptual=none"
PICTURES = "PHOTO PHOTO2 --model MODEL --device cpu --frame none"
FILM = f"{PICTURES} --size 64 --stills 2 --film gif,mp4 --frames 6"
COMMANDS = {  # what to write, and what is given beside it once the file or folder named third is there
    "train": (f"train --data DATA --preset small --device cpu {LEARNS} --out", *RUN),
    "finetune": (f"finetune --data DATA --preset small --device cpu {LEARNS} {LABELS} --out", *RUN),
    "embed": (f"embed {MADE} --batch-size 4 --out", "table.parquet", "", "--force"),
    "identify": (f"evaluate identify {MADE} {SCORED} --label class --force --json", "scores.json", "", ""),
    "explain": (f"explain {MADE} --label class --seeds 2 --sheets 1 --rows 3 --out", "why", "", "--force"),
    "report": ("report RUN DATA --label class --device cpu --force --out", "page.html", "", ""),
    "plan": ("compare --plan PLAN --device cpu --out", "compared", "", ""),
    "compare": (f"compare --table identity {TABLES} --force --json", "scores.json", "", ""),
    "whiten": (f"whiten {MADE} --set pictures=8 --out", "white", "", "--force"),
    "refine": (f"refine DATA --model rendered-faces-64 --device cpu {FEW} --out", "refined", "", "--force"),
    "unet": (f"unet {MADE} --set images=16 --out", "unet", "", "--force"),
    "pack": ("pack --model MODEL --out", "packed", "", "--force"),
    "align": ("align FACES --size 32 --out", "aligned", "boxes.csv", "--force"),
    "decompose": (f"decompose {PICTURES} --out", "parts", "", "--force"),
    "relight": (f"relight {FILM} --out", "relit", "", "--resume"),
    "rotate": (f"rotate {FILM} --out", "turned", "", "--force"),
    "swap": (f"swap {PICTURES} --size 64 --from PHOTO2 --out", "mixed", "", "--force"),
    "mesh": (f"mesh {PICTURES} --out", "solid", "", "--force"),
    "video": ("relight CLIP --model MODEL --device cpu --frame none --out", "clips", "", "--force"),
}


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

    ``disk`` may be a small disk of its own (``mounted``); ``log`` has what the command said last, ``numbers``
    draws moments. ``seconds``, ``bytes``, ``writes``: how long the command takes undisturbed, what it leaves
    and writes. ``kills`` by cause, ``writing`` of them while a file was written; ``rounds`` brought to their
    end, ``survived`` of these with the undisturbed result; ``faults`` in sentences.
    """

    name: str
    words: dict[str, str]
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

    def arguments(self, folder: Path) -> list[str]:
        """Of the first attempt, or of a later one where it left something."""
        text, out, begun, again = COMMANDS[self.name]
        words = {**self.words, "OUT": str(folder)}
        given = [words.get(word, word) for word in text.split()]
        for mark, end in (("OUT/", f"{folder}/"), ("=ONE", f"={words['ONE']}"), ("=TWO", f"={words['TWO']}")):
            given = [word.replace(mark, end) for word in given]
        return [*given, str(folder / out), *(again.split() if (folder / out / begun).exists() else [])]

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
                code = main(self.arguments(folder))
            except Injected:
                return INJECTED
            if record:
                self.log.with_suffix(".record").write_text("\n".join((str(writes.begun), *sys.modules)))
            return code

        return start(work, self.log)

    def undisturbed(self, folder: Path) -> dict[str, bytes]:
        """What an undisturbed run leaves; notes time and bytes it takes, and imports what it did.

        Later processes begin with those modules, and are killed at work.
        """
        folder.mkdir()
        began = time.monotonic()
        if waited(self.child(folder, record=True), 1800) != CAME_THROUGH:
            raise RuntimeError(f"{self.name} does not come through:\n{self.log.read_text()}")
        self.seconds = time.monotonic() - began
        self.bytes = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
        writes, *modules = self.log.with_suffix(".record").read_text().splitlines()
        self.writes = int(writes)
        for name in modules:
            if name.split(".")[0] in PRELOADED:
                importlib.import_module(name)
        result = left_in(folder)
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
        elif cause in SIGNALS and draw.random() < 0.5 and self.writes:
            how["hold"] = draw.randint(1, self.writes), round(10 ** draw.uniform(0.5, 3))
        child = self.child(folder, **how)
        code = waited(child, moment if cause in SIGNALS and not how else 1800)
        if code in (None, "stopped") and cause in SIGNALS:
            self.writing += code == "stopped"
            os.kill(child, SIGNALS[cause])
            os.kill(child, signal.SIGCONT)
            code = waited(child, 1800)
        filler.unlink(missing_ok=True)
        if not isinstance(code, int):
            os.kill(child, signal.SIGKILL)
            raise TimeoutError(f"{self.name} did not end within 30 minutes of {cause}")
        return code

    def check(self, folder: Path, cause: str, code: int) -> None:
        """After a kill: an ending as promised, no traceback, and nothing half-written on disk."""
        message = self.log.read_text(errors="replace")
        if code not in ENDINGS.get(cause, ()) or "Traceback" in message.partition("Exception ignored in")[0]:
            self.faults.append(f"{self.name} ended by {cause} with exit code {code}: {message[-1500:]}")
        try:
            left_in(folder)
        except (ValueError, OSError) as problem:
            self.faults.append(f"after {cause} {self.name} left something half-written: {problem}")

    def kill(self, kills: int, after: Callable[[], None]) -> None:
        """Kill the command so many times in all, from as many beginnings; calls ``after`` each of these."""
        folder = self.disk / "work"  # what is written may name it
        self.undisturbed(folder)
        wanted = self.undisturbed(folder)
        while (done := self.kills.total()) < kills:
            code = -1
            folder.mkdir()
            self.rounds += 1
            while code != CAME_THROUGH and done <= kills:
                cause, began = CAUSES[done % len(CAUSES)] if done < kills else "nothing", time.monotonic()
                code = self.attempt(folder, cause)
                if code == CAME_THROUGH and FAILED in self.log.read_text(errors="replace"):
                    code = INJECTED
                if code == CAME_THROUGH:  # it takes no longer than that: draw earlier moments
                    self.seconds = min(self.seconds, time.monotonic() - began)
                    continue
                self.kills[cause] += 1
                done += 1
                self.check(folder, cause, code)
            left = left_in(folder) if code == CAME_THROUGH else {}
            self.survived += left == wanted
            if differing := [name for name in wanted | left if wanted.get(name) != left.get(name)]:
                self.faults.append(f"round {self.rounds} of {self.name} ended otherwise: {differing[:5]}")
            shutil.rmtree(folder)
            self.tell()
            after()

    def tell(self) -> None:
        by_cause = ", ".join(f"{cause} {count}" for cause, count in sorted(self.kills.items()))
        message = f"{self.name}: {self.kills.total()} kills ({by_cause}), {self.writing} while writing; "
        message += f"{self.survived} of {self.rounds} runs ended bit-identical to the undisturbed one; "
        print(f"{message}{len(self.faults)} faults", flush=True)

    def numbers_told(self) -> dict[str, object]:
        """For ``--json``."""
        counts = {name: getattr(self, name) for name in ("writing", "rounds", "survived", "faults")}
        date = f"{datetime.now(UTC):%Y-%m-%d}"
        return {"date": date, "kills": self.kills.total(), "by_cause": dict(self.kills), **counts}


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


def run(given: Namespace) -> int:
    """The script."""
    embedding_module.PART_ROWS = 8
    faults: list[str] = []
    earlier = json.loads(given.json.read_text())["commands"] if given.json and given.json.exists() else {}
    told = {"command": f"python tests/trust/kills.py --kills {given.kills} --seed {given.seed}"}
    told |= {"commands": {name: row for name, row in earlier.items() if name in COMMANDS}}
    with tempfile.TemporaryDirectory() as folder:
        words = {**made_material(Path(folder), given.pictures)}
        words["MODEL"] = given.model or made_model(Path(folder))
        words |= made_runs(Path(folder), words["DATA"], words["MODEL"])
        for name in given.what.split(","):
            if earlier.get(name, {}).get("kills", 0) >= given.kills:
                continue
            with small_disk(not given.no_mount) as (disk, mounted):
                trial = Trial(name, words, disk, mounted, Path(folder) / "log", random.Random(given.seed))

                def save(trial: Trial = trial, name: str = name) -> None:
                    told["commands"][name] = trial.numbers_told()
                    if given.json:
                        given.json.write_text(json.dumps(told, indent=1) + "\n")

                try:
                    trial.kill(given.kills, save)
                except (RuntimeError, TimeoutError) as problem:
                    trial.faults.append(str(problem))
                save()
            faults += trial.faults
    for fault in faults:
        print(f"  {fault}")
    return 1 if faults else 0


if __name__ == "__main__":
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=30, help="of each command")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--pictures", type=int, default=40, help="in the data set")
    parser.add_argument("--model", help="that embeds and draws; an untrained one where none is named")
    parser.add_argument("--no-mount", action="store_true", help="limit the size of files instead")
    parser.add_argument("--what", default=",".join(COMMANDS))
    parser.add_argument("--json", type=Path, help="file for the counts, to which missing commands are added")
    sys.exit(run(parser.parse_args()))
