"""Trains, embeds and serves at once, for an hour, and tells whether anything grows.

    python tests/trust/soak.py --minutes 60 --clients 20 --json soak.json

One ``derender train`` that checkpoints and validates often, one process that embeds again and again by the
Python API (soaking/embedding.py), ``derender embed`` as a command once a minute, and ``derender view`` under
many clients (soaking/clients.py), all on generated images in a temporary folder. Memory, descriptors,
threads, children and files are sampled and have to be flat after the first quarter (soaking/measure.py). Then
all are told to end, and nothing may be left but a run that can be resumed, which it is. Linux only.
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
from collections import Counter, defaultdict
from dataclasses import asdict
from pathlib import Path

from soaking.clients import Answers, Visitor, encoded, nuisance
from soaking.measure import BOUNDS, Verdict, files_below, markdown, measured, of_group, verdict

MODEL = "rendered-faces-64"
PICTURES, UPLOADS, BATCH = 600, 40, 16
TRAINING = ("optimiser.learning_rate=1e-5", f"batch_size={BATCH}", "patience=1000000")
TRAINING += ("validate_every=400", "checkpoint_every=400", "sample_every=4000")
TRAINING += ("self_features_steps=20", "whitening.pictures=16")
START_SECONDS, PATIENCE_SECONDS = 600.0, 180.0
COMMAND_EVERY_SECONDS, NUISANCE_SECONDS = 45.0, 3.0
SHORT_MINUTES = 15
LASTING = {"view": (signal.SIGINT, 0), "embed, one process": (signal.SIGTERM, 0)}
LASTING["train"] = (signal.SIGTERM, 130)
"""Processes that run all the time: the signal that ends each, and the exit code that is due."""


class Soak:
    """Everything that runs, and what was measured.

    Attributes:
        series: pairs of seconds and value, by process and quantity.
        faults: sentences on what went wrong.
        running: processes that have not ended, by name; each leads a group of its own.
        counts: of what was done meanwhile.
    """

    def __init__(self, folder: Path, minutes: float, clients: int, pause_seconds: float):
        self.folder, self.seconds = folder, 60 * minutes
        self.clients, self.pause_seconds = clients, pause_seconds
        self.series: dict[str, dict[str, list[tuple[float, float]]]] = defaultdict(lambda: defaultdict(list))
        self.faults: list[str] = []
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        self.counts: Counter[str] = Counter()
        self.answers, self.stop = Answers(), threading.Event()
        self.began = time.monotonic()
        self.places = {name: folder / name for name in ("tmp", "cache", "tables", "run")}
        for name in ("tmp", "cache", "tables", "logs"):
            (folder / name).mkdir()

    def log(self, name: str) -> Path:
        return self.folder / "logs" / f"{name}.txt"

    def said(self, name: str) -> str:
        return self.log(name).read_text(errors="replace")[-800:]

    def start(self, name: str, *arguments: str) -> subprocess.Popen[bytes]:
        """A process in a group of its own, with one thread for arithmetic and its own temporary folder."""
        own = self.places["tmp"] / name
        own.mkdir(exist_ok=True)
        one = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
        places = {"TMPDIR": str(own), "DERENDER_CACHE": str(self.places["cache"])}
        with self.log(name).open("wb") as stream:
            self.running[name] = subprocess.Popen(
                [sys.executable, *arguments], stdin=subprocess.DEVNULL, stdout=stream, stderr=stream,
                env={**os.environ, **one, **places}, process_group=0,
            )  # fmt: skip
        return self.running[name]

    def run(self, name: str, *arguments: str) -> float:
        """A command to its end; gives its largest memory in MB, or raises with what it said."""
        process = self.start(name, "-m", "derender", *arguments)
        _, status, used = os.wait4(process.pid, 0)
        code = process.returncode = os.waitstatus_to_exitcode(status)
        left = of_group(process.pid)
        if code or left:
            raise RuntimeError(f"{name} ended with {code}, left {len(left)} processes: {self.said(name)}")
        del self.running[name]
        return used.ru_maxrss / 1024

    def embedding(self, out: str) -> tuple[str, ...]:
        given = ("embed", "--model", MODEL, "--data", str(self.folder / "data"), "--device", "cpu", "--force")
        return (*given, "--out", str(self.places["tables"] / out))

    def training(self, images: int) -> tuple[str, ...]:
        settings = [f"--set={setting}" for setting in (*TRAINING, f"images={images}")]
        given = ("train", "--data", str(self.folder / "data"), "--out", str(self.places["run"]))
        return (*given, "--preset", "small", "--start-from", MODEL, "--device", "cpu", *settings)

    def begin(self) -> int:
        """Make images and a table, start everything; gives the viewer's port."""
        data, told = self.folder / "data", self.folder / "viewer.json"
        self.run("synth", "synth", "faces", "--out", str(data), "--count", str(PICTURES), "--no-truth")
        shutil.make_archive(str(data), "zip", data)
        self.run("embed", *self.embedding("shown.parquet"))
        view = ("view", "--model", MODEL, "--features", str(self.places["tables"] / "shown.parquet"))
        again = (str(Path(__file__).parent / "soaking" / "embedding.py"), str(self.folder), MODEL)
        signs = {
            "view": (("-m", "derender", *view, "--device", "cpu", "--json", str(told)), told),
            "embed, one process": (again, self.folder / "passes.txt"),
            "train": (
                ("-m", "derender", *self.training(10**9)),
                self.places["run"] / "checkpoints" / "previous",
            ),
        }
        for name, (arguments, sign) in signs.items():
            process, until = self.start(name, *arguments), time.monotonic() + START_SECONDS
            while not sign.exists():
                if process.poll() is not None or time.monotonic() > until:
                    raise RuntimeError(f"{name} does not start: {self.said(name)}")
                time.sleep(0.2)
        return int(json.loads(told.read_text())["port"])

    def embed_by_command(self) -> None:
        """``derender embed`` again and again, each in a process of its own."""
        while not self.stop.wait(min(COMMAND_EVERY_SECONDS, self.seconds / 20)):
            try:
                peak = self.run("embed", *self.embedding("command.parquet"))
            except RuntimeError as problem:
                if not self.stop.is_set():
                    self.faults.append(str(problem))
                return
            self.note("embed, by command", peak_mb=peak)
            self.counts["embedded by command"] += 1

    def note(self, name: str, **values: float) -> None:
        for quantity, value in values.items():
            self.series[name][quantity].append((time.monotonic() - self.began, value))

    def load(self, every_seconds: float) -> None:
        """Keep all under load for the time asked, and sample."""
        port = self.begin()
        uploads = encoded(sorted((self.folder / "data" / "images").iterdir())[:UPLOADS])
        works = [
            Visitor(port, number, uploads, PICTURES, self.pause_seconds, self.answers, self.stop).run
            for number in range(self.clients)
        ]
        works.append(lambda: nuisance(port, NUISANCE_SECONDS, self.answers, self.stop))
        works.append(self.embed_by_command)
        threads = [threading.Thread(target=work, daemon=True) for work in works]
        self.began = time.monotonic()
        for thread in threads:
            thread.start()
        try:
            while time.monotonic() - self.began < self.seconds:
                if not self.stop.wait(every_seconds):
                    self.sample(every_seconds)
        finally:
            self.stop.set()
        for thread in threads:
            thread.join(PATIENCE_SECONDS)
            if thread.is_alive():
                self.faults.append("a thread of the load hangs")

    def sample(self, over_seconds: float) -> None:
        for name in LASTING.keys() & self.running.keys():
            process = self.running[name]
            if process.poll() is None:
                self.note(name, **measured(process.pid))
            else:
                self.faults.append(f"{name} ended by itself with {process.returncode}: {self.said(name)}")
                del self.running[name]
        for name, place in self.places.items():
            self.note(f"files in {name}/", files=float(len(files_below(place, without="samples"))))
        waits = [wait for _, wait in self.answers.waits[self.counts["answers"] :]]
        self.counts["answers"] += len(waits)
        self.note("clients", per_second=len(waits) / over_seconds, longest_s=max(waits, default=0.0))
        if not waits:
            self.faults.append(f"no answer for {over_seconds:.0f} s")

    def end(self) -> None:
        """Ctrl-C or SIGTERM for each, then look what is left, and go on with the run."""
        for name in LASTING.keys() & self.running.keys():
            process, (number, due) = self.running[name], LASTING[name]
            process.send_signal(number)
            try:
                code = process.wait(PATIENCE_SECONDS)
            except subprocess.TimeoutExpired:
                self.faults.append(f"{name} still runs {PATIENCE_SECONDS:.0f} s after {number.name}")
                continue
            left = of_group(process.pid)
            if code != due or left or "Traceback" in self.said(name):
                how = f"ended by {number.name} with {code} and left {len(left)} processes"
                self.faults.append(f"{name} {how}: {self.said(name)}")
            del self.running[name]
        temporary = [
            str(entry)
            for entry in self.places["tmp"].glob("*/*")
            if not entry.name.startswith("torchinductor_") or any(entry.iterdir())  # PyTorch makes it, empty
        ]
        found = [f"/{name}" for place in self.places.values() for name in files_below(place)]
        unfinished = [name for name in found if "/." in name or ".partial" in name]
        for what, names in (("temporary", temporary), ("unfinished", unfinished)):
            if names:
                self.faults.append(f"{len(names)} {what} files or folders are left: {', '.join(names[:5])}")
        self.counts["passes in one process"] = int((self.folder / "passes.txt").read_text())
        try:
            state = self.places["run"] / "checkpoints" / "last" / "state.json"
            self.counts["images trained on"] = json.loads(state.read_text())["state"]["images"]
            metrics = (self.places["run"] / "metrics.jsonl").read_text()
            self.counts["validations"] = metrics.count('"kind": "validation"')
            images = self.counts["images trained on"] + 10 * BATCH
            self.run("resume", *self.training(images), "--resume")
        except (OSError, LookupError, RuntimeError) as problem:
            self.faults.append(f"the run cannot be resumed: {problem}")

    def kill(self) -> None:
        """End by force what still runs."""
        self.stop.set()
        for process in self.running.values():
            for number in of_group(process.pid):
                os.kill(number, signal.SIGKILL)

    def judged(self) -> dict[str, dict[str, Verdict]]:
        """The verdict on every quantity that has a bound; what grows or failed becomes a fault."""
        found: dict[str, dict[str, Verdict]] = defaultdict(dict)
        for name, quantities in self.series.items():
            for quantity in (one for one in BOUNDS if one in quantities):
                try:
                    one = found[name][quantity] = verdict(quantities[quantity], BOUNDS[quantity])
                except ValueError as problem:
                    if self.seconds >= 60 * SHORT_MINUTES:
                        self.faults.append(f"{name}, {quantity}: {problem}")
                    continue
                if one.grows:
                    self.faults.append(f"{name}: {quantity} grows from {one.before:,.1f} to {one.after:,.1f}")
        self.faults += [f"a client's {kind} failed: {why}" for kind, why in self.answers.failures[:20]]
        return found


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--clients", type=int, default=20)
    parser.add_argument("--pause", type=float, default=2.0, help="mean seconds between a client's requests")
    parser.add_argument("--every", type=float, default=10.0, help="seconds between samples")
    parser.add_argument("--json", type=Path, help="file for all samples and verdicts")
    asked = parser.parse_args()
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
    verdicts = soak.judged()
    print(markdown(verdicts), soak.answers.told(), sep="\n\n", end="\n\n")
    print(", ".join(f"{count:,} {what}" for what, count in soak.counts.items()))
    print("odd connections that were ended:", dict(Counter(soak.answers.ended)))
    print(*(f"FAULT: {fault}" for fault in soak.faults), f"{len(soak.faults)} faults", sep="\n")
    if asked.minutes < SHORT_MINUTES:
        print(f"{asked.minutes:g} minutes prove little: slow leaks and late growth need an hour.")
    if asked.json is not None:
        told = {name: {key: asdict(one) for key, one in row.items()} for name, row in verdicts.items()}
        facts = {
            "minutes": asked.minutes, "clients": asked.clients, "faults": soak.faults, "counts": soak.counts,
            "verdicts": told,
            "answers": soak.answers.told(), "ended_connections": Counter(soak.answers.ended),
            "samples": soak.series,
        }  # fmt: skip
        asked.json.write_text(json.dumps(facts, indent=1) + "\n")
    return 1 if soak.faults else 0


if __name__ == "__main__":
    sys.exit(main())
