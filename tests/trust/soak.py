"""Trains, embeds and serves at once, for an hour, and tells whether anything grows.

    python tests/trust/soak.py --minutes 60 --clients 20 --json soak.json --png soak.png

One ``derender train`` that checkpoints and validates often, one process that embeds again and again by the
Python API (soaking/embedding.py), ``derender embed`` as a command once a minute, and ``derender view`` under
many clients (soaking/clients.py), all on generated images in a temporary folder. Memory, descriptors,
threads, children and files are sampled (soaking/measure.py) and have to be flat after the first quarter
(soaking/flat.py). Then all are told to end, and nothing may be left but a run that can be resumed, which it
is. Linux only.
"""

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from soaking.clients import Answers, Nuisance, Visitor, encoded
from soaking.flat import BOUNDS, Series, Verdict, draw, markdown, verdict
from soaking.measure import files_below, measured, of_group

from derender.cli.console import progress_bar

MODEL = "rendered-faces-64"
PICTURES, UPLOADS, BATCH = 600, 40, 16
TRAINING = (
    "optimiser.learning_rate=1e-5",
    f"batch_size={BATCH}",
    "validate_every=400",
    "checkpoint_every=400",
    "sample_every=4000",
    "patience=1000000",
    "self_features_steps=20",
    "whitening.pictures=16",
)
START_SECONDS, PATIENCE_SECONDS = 600.0, 180.0
COMMAND_EVERY_SECONDS = 45.0
NUISANCE_SECONDS = 3.0
SHORT_MINUTES = 15
PANELS = {
    "private memory, MB": ("private_mb", "peak_mb"),
    "descriptors": ("descriptors",),
    "threads": ("threads",),
    "answers per second": ("per_second",),
    "longest wait, s": ("longest_s",),
}


@dataclass
class Watched:
    """A process with its log."""

    name: str
    process: subprocess.Popen[bytes]
    log: Path

    @property
    def end_of_log(self) -> str:
        return self.log.read_text(errors="replace")[-800:]


class Soak:
    """Everything that runs, and what was measured.

    Attributes:
        series: by process and quantity.
        faults: sentences on what went wrong.
        lasting: processes that run all the time.
        passing: processes that somebody waits for.
    """

    def __init__(self, folder: Path, minutes: float, clients: int, pause_seconds: float):
        self.folder, self.seconds = folder, 60 * minutes
        self.clients, self.pause_seconds = clients, pause_seconds
        self.series: dict[str, dict[str, Series]] = {}
        self.faults: list[str] = []
        self.lasting: list[Watched] = []
        self.passing: list[Watched] = []
        self.answers, self.stop = Answers(), threading.Event()
        self.commands = self.passes = self.images = self.validations = 0
        self.began = self.sampled = time.monotonic()
        self.places = {name: folder / name for name in ("tmp", "cache", "tables", "run")}
        for name in ("tmp", "cache", "tables", "logs"):
            (folder / name).mkdir()

    def start(self, name: str, arguments: Sequence[str]) -> Watched:
        """A process in a group of its own, with one thread for arithmetic and its own temporary folder."""
        own = self.places["tmp"] / name.replace(", ", "-")
        own.mkdir(exist_ok=True)
        one = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
        places = {"TMPDIR": str(own), "DERENDER_CACHE": str(self.places["cache"])}
        log = self.folder / "logs" / f"{own.name}.txt"
        with log.open("wb") as stream:
            process = subprocess.Popen(
                [sys.executable, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=stream,
                env={**os.environ, **one, **places},
                process_group=0,
            )
        return Watched(name, process, log)

    def run(self, name: str, *arguments: str) -> float:
        """A command to its end; gives its largest memory in MB, or raises with what it said."""
        watched = self.start(name, ["-m", "derender", *arguments])
        self.passing.append(watched)
        _, status, used = os.wait4(watched.process.pid, 0)
        code = watched.process.returncode = os.waitstatus_to_exitcode(status)
        left = of_group(watched.process.pid)
        self.passing.remove(watched)
        if code or left:
            raise RuntimeError(
                f"{name} ended with {code} and left {len(left)} processes: {watched.end_of_log}"
            )
        return used.ru_maxrss / 1024

    def embedding(self, out: str) -> tuple[str, ...]:
        table, data = self.places["tables"] / out, self.folder / "data"
        return (
            "embed",
            "--model",
            MODEL,
            "--data",
            str(data),
            "--out",
            str(table),
            "--device",
            "cpu",
            "--force",
        )

    def training(self, images: int) -> tuple[str, ...]:
        settings = [text for setting in (*TRAINING, f"images={images}") for text in ("--set", setting)]
        given = ("train", "--data", str(self.folder / "data"), "--out", str(self.places["run"]))
        return (*given, "--preset", "small", "--start-from", MODEL, "--device", "cpu", *settings)

    def begin(self) -> int:
        """Make images and a table, start everything; gives the viewer's port."""
        data, said = self.folder / "data", self.folder / "viewer.json"
        self.run("synth", "synth", "faces", "--out", str(data), "--count", str(PICTURES), "--no-truth")
        shutil.make_archive(str(data), "zip", data)
        self.run("embed", *self.embedding("shown.parquet"))
        view = ("view", "--model", MODEL, "--features", str(self.places["tables"] / "shown.parquet"))
        again = (str(Path(__file__).parent / "soaking" / "embedding.py"), str(self.folder), MODEL)
        checkpoint = self.places["run"] / "checkpoints" / "previous"
        for name, arguments, sign in (
            ("view", ("-m", "derender", *view, "--device", "cpu", "--json", str(said)), said),
            ("embed, one process", again, self.folder / "passes.txt"),
            ("train", ("-m", "derender", *self.training(10**9)), checkpoint),
        ):
            self.lasting.append(self.start(name, arguments))
            self.wait_for(sign, name)
        return int(json.loads(said.read_text())["port"])

    def wait_for(self, sign: Path, name: str) -> None:
        """Until a process has written what shows that it works."""
        until = time.monotonic() + START_SECONDS
        while not sign.exists():
            self.check_alive()
            if self.faults or time.monotonic() > until:
                raise RuntimeError(f"{name} does not start: {self.faults or self.lasting[-1].end_of_log}")
            time.sleep(0.2)

    def check_alive(self) -> None:
        """A process that ended by itself is a fault, told once."""
        for watched in list(self.lasting):
            if watched.process.poll() is not None:
                code = watched.process.returncode
                self.faults.append(f"{watched.name} ended by itself with {code}: {watched.end_of_log}")
                self.lasting.remove(watched)

    def embed_by_command(self) -> None:
        """``derender embed`` again and again, each in a process of its own."""
        while not self.stop.wait(min(COMMAND_EVERY_SECONDS, self.seconds / 20)):
            try:
                peak = self.run("embed", *self.embedding("command.parquet"))
            except RuntimeError as problem:
                if not self.stop.is_set():
                    self.faults.append(str(problem))
                return
            if not self.stop.is_set():
                self.note("embed, by command", peak_mb=peak)
                self.commands += 1

    def note(self, name: str, **values: float) -> None:
        now = time.monotonic() - self.began
        for quantity, value in values.items():
            series = self.series.setdefault(name, {}).setdefault(quantity, Series())
            series.seconds.append(now)
            series.values.append(value)

    def load(self, every_seconds: float) -> None:
        """Keep all under load for the time asked, and sample."""
        port = self.begin()
        uploads = encoded(sorted((self.folder / "data" / "images").iterdir())[:UPLOADS])
        threads: list[threading.Thread] = [
            Visitor(port, number, uploads, PICTURES, self.pause_seconds, self.answers, self.stop)
            for number in range(self.clients)
        ]
        threads.append(Nuisance(port, NUISANCE_SECONDS, self.answers, self.stop))
        threads.append(threading.Thread(target=self.embed_by_command, name="embed by command", daemon=True))
        self.began = self.sampled = time.monotonic()
        for thread in threads:
            thread.start()
        try:
            with progress_bar("soaking", "s") as report:
                while (now := time.monotonic() - self.began) < self.seconds:
                    if not self.stop.wait(every_seconds):
                        self.sample(every_seconds)
                    failed = sum(self.answers.failures.values())
                    report(int(now), int(self.seconds), f"{self.answers.count:,} answers, {failed} failed")
        finally:
            self.stop.set()
        for thread in threads:
            thread.join(PATIENCE_SECONDS)
            if thread.is_alive():
                self.faults.append(f"a thread of the load hangs: {thread.name}")

    def sample(self, over_seconds: float) -> None:
        self.check_alive()
        for watched in self.lasting:
            self.note(watched.name, **measured(watched.process.pid))
        for name, place in self.places.items():
            self.note(f"files in {name}/", files=float(len(files_below(place, without="samples"))))
        count, longest = self.answers.since_last()
        passed, self.sampled = time.monotonic() - self.sampled, time.monotonic()
        self.note("clients", per_second=count / passed, longest_s=longest)
        if not count:
            self.faults.append(f"no answer for {over_seconds:.0f} s")

    def end(self) -> None:
        """Ctrl-C or SIGTERM for each, then look what is left, and go on with the run."""
        due = {
            "view": (signal.SIGINT, 0),
            "train": (signal.SIGTERM, 130),
            "embed, one process": (signal.SIGTERM, 0),
        }
        for watched in list(self.lasting):
            number, wanted = due[watched.name]
            watched.process.send_signal(number)
            try:
                code = watched.process.wait(PATIENCE_SECONDS)
            except subprocess.TimeoutExpired:
                self.faults.append(f"{watched.name} still runs {PATIENCE_SECONDS:.0f} s after {number.name}")
                continue
            left = of_group(watched.process.pid)
            if code != wanted or left or "Traceback" in watched.end_of_log:
                how = f"ended by {number.name} with {code} and left {len(left)} processes"
                self.faults.append(f"{watched.name} {how}: {watched.end_of_log}")
            self.lasting.remove(watched)
        temporary = [
            str(entry)
            for own in self.places["tmp"].iterdir()
            for entry in own.iterdir()
            if not entry.name.startswith("torchinductor_") or any(entry.iterdir())  # PyTorch makes it, empty
        ]
        found = [f"/{name}" for place in self.places.values() for name in files_below(place)]
        unfinished = [name for name in found if "/." in name or ".partial" in name]
        for what, names in (("temporary", temporary), ("unfinished", unfinished)):
            if names:
                self.faults.append(f"{len(names)} {what} files or folders are left: {', '.join(names[:5])}")
        counted = self.folder / "passes.txt"
        self.passes = int(counted.read_text()) if counted.exists() else 0
        try:
            state = self.places["run"] / "checkpoints" / "last" / "state.json"
            self.images = json.loads(state.read_text())["state"]["images"]
            metrics = (self.places["run"] / "metrics.jsonl").read_text().splitlines()
            self.validations = sum(json.loads(line)["kind"] == "validation" for line in metrics)
            self.run("resume", *self.training(self.images + 10 * BATCH), "--resume")
        except (OSError, LookupError, RuntimeError) as problem:
            self.faults.append(f"the run cannot be resumed: {problem}")

    def kill(self) -> None:
        """End by force what still runs, and wait for it."""
        self.stop.set()
        for watched in [*self.lasting, *self.passing]:
            until = time.monotonic() + 10
            while (numbers := of_group(watched.process.pid)) and time.monotonic() < until:
                for number in numbers:
                    os.kill(number, signal.SIGKILL)
                time.sleep(0.1)


def judge(soak: Soak) -> dict[str, dict[str, Verdict]]:
    """The verdict on every quantity that has a bound; what grows or failed becomes a fault."""
    found: dict[str, dict[str, Verdict]] = {}
    for name, quantities in soak.series.items():
        for quantity in BOUNDS.keys() & quantities.keys():
            try:
                one = verdict(quantities[quantity], BOUNDS[quantity])
            except ValueError as problem:
                if soak.seconds >= 60 * SHORT_MINUTES:
                    soak.faults.append(f"{name}, {quantity}: {problem}")
                continue
            found.setdefault(name, {})[quantity] = one
            if one.grows:
                soak.faults.append(f"{name}: {quantity} grows from {one.before:,.1f} to {one.after:,.1f}")
    soak.faults += [f"{count} x {kind} failed" for kind, count in soak.answers.failures.items()]
    return {name: {key: found[name][key] for key in BOUNDS if key in found[name]} for name in found}


def told(soak: Soak, verdicts: dict[str, dict[str, Verdict]]) -> str:
    """All of it as Markdown."""
    held = ", ".join(f"{count} {kind}" for kind, count in sorted(soak.answers.held.items()))
    lines = [
        markdown(verdicts),
        "",
        soak.answers.markdown(),
        "",
        f"{soak.images:,} images trained on with {soak.validations} validations; {soak.commands} times "
        f"embedded by command, {soak.passes:,} passes in one process. Odd lines ended: {held or 'none'}.",
        "",
        *(f"FAULT: {fault}" for fault in soak.faults),
        *(f"FAULT of a client: {sentence}" for sentence in soak.answers.said),
        f"{len(soak.faults)} faults",
    ]
    if soak.seconds < 60 * SHORT_MINUTES:
        lines.append(f"{soak.seconds / 60:g} minutes prove little: slow leaks and late growth need an hour.")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--clients", type=int, default=20)
    parser.add_argument("--pause", type=float, default=2.0, help="mean seconds between a client's requests")
    parser.add_argument("--every", type=float, default=10.0, help="seconds between samples")
    parser.add_argument("--json", type=Path, help="file for all samples and verdicts")
    parser.add_argument("--png", type=Path, help="file for the curves")
    asked = parser.parse_args(arguments)
    if not Path("/proc/self/smaps_rollup").exists():
        parser.error("memory is read from /proc/PID/smaps_rollup: run this on Linux")
    if asked.minutes < 0.5 or asked.clients < 1 or asked.pause <= 0 or asked.every <= 0:
        parser.error("--minutes must be 0.5 or more, --clients 1 or more, --pause and --every above 0")
    for number in (signal.SIGINT, signal.SIGTERM):  # a shell has SIGINT ignored in the background
        signal.signal(number, signal.default_int_handler)
    with tempfile.TemporaryDirectory(prefix="derender-soak-") as folder:
        soak = Soak(Path(folder), asked.minutes, asked.clients, asked.pause)
        try:
            soak.load(min(asked.every, asked.minutes * 60 / 40))
            soak.end()
        except KeyboardInterrupt:
            print("stopped; every process that was started is ended", file=sys.stderr)
            return 130
        finally:
            soak.kill()
    verdicts = judge(soak)
    print(told(soak, verdicts))
    if asked.json is not None:
        facts = {
            "minutes": asked.minutes,
            "clients": asked.clients,
            "faults": soak.faults,
            "images": soak.images,
            "validations": soak.validations,
            "commands": soak.commands,
            "passes": soak.passes,
            "verdicts": {
                name: {key: asdict(one) for key, one in row.items()} for name, row in verdicts.items()
            },
            "answers": soak.answers.rows(),
            "ended_connections": soak.answers.held,
            "samples": {
                name: {key: asdict(one) for key, one in row.items()} for name, row in soak.series.items()
            },
        }
        asked.json.write_text(json.dumps(facts, indent=1) + "\n")
    if asked.png is not None:
        draw(soak.series, PANELS, asked.png)
    return 1 if soak.faults else 0


if __name__ == "__main__":
    sys.exit(main())
