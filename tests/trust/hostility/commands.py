"""Every command that reads images, run in a process of its own, and uploads of them to the viewer."""

import os
import resource
import time
from dataclasses import dataclass
from pathlib import Path

from apart import start
from hostility.files import Hostile

from derender.cli import main

MODEL = "rendered-faces-64"
TINY_RUN = ("image_size=32", "width=4", "light_width=4", "images=16", "batch_size=8")
TINY_RUN += ("perceptual=none", "whitening.pictures=8")


@dataclass(frozen=True)
class Ended:
    """How a command ended in a process of its own: exit code, seconds, peak memory in MB, what it said."""

    code: int
    seconds: float
    megabytes: float
    said: str


def run_apart(arguments: list[str], log: Path, *, seconds: int = 600) -> Ended:
    """Run one command in a process of its own."""

    def work() -> int:
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        return main(arguments)

    began = time.monotonic()
    child = start(work, log)
    _, status, usage = os.wait4(child, 0)
    return Ended(
        os.waitstatus_to_exitcode(status),
        time.monotonic() - began,
        usage.ru_maxrss / 1024,
        log.read_text(errors="replace"),
    )


def commands(place: Path, data: Path) -> dict[str, tuple[list[str], int]]:
    """Commands that read a folder, by name: their arguments, and the exit code that is due."""
    reads = ["--model", MODEL, "--data", str(data), "--device", "cpu"]
    small = [text for setting in TINY_RUN for text in ("--set", setting)]
    train = ["--data", str(data), "--device", "cpu", *small]
    few = ["--resamples", "20"]
    taught = [f"--set={text}" for text in ("images=16", "fitted=8", "fit_steps=2", "whitening.pictures=8")]
    label, once, run = ["--label", "class"], ["--counts", "20", "--seeds", "1"], str(place / "run")
    return {
        "doctor": (["doctor", str(data)], 0),
        "train": (["train", *train, "--preset", "small", "--out", run], 0),
        "report": (["report", run, *reads[2:], "--force"], 0),
        "finetune": (["finetune", *train, *label, "--model", run, "--out", str(place / "tuned")], 0),
        "whiten": (["whiten", *reads, "--set", "pictures=8", "--out", str(place / "white")], 0),
        "refine": (["refine", *reads, *taught, "--out", str(place / "refined")], 0),
        "unet": (["unet", *reads, "--set", "images=16", "--out", str(place / "unet")], 0),
        "embed": (["embed", *reads, "--out", str(place / "F.parquet")], 0),
        "evaluate cluster": (["evaluate", "cluster", *reads, *label, *few], 0),
        "evaluate linear": (["evaluate", "linear", *reads, *label, *few, *once], 0),
        "evaluate reconstruction": (["evaluate", "reconstruction", *reads, *few], 0),
        "evaluate robustness": (["evaluate", "robustness", *reads, *few, "--limit", "40"], 0),
        "evaluate geometry": (["evaluate", "geometry", *reads, *few], 2),
        "evaluate disentangle": (["evaluate", "disentangle", *reads], 2),
        "evaluate segment": (["evaluate", "segment", *reads, *few], 2),
        "compare": (["compare", "--table", "cars", "--model", f"m={MODEL}", *reads[2:], *few], 0),
        "explain": (["explain", *reads, *label, "--seeds", "1", "--out", str(place / "why")], 0),
    }  # fmt: skip


def picture_commands(place: Path, pictures: list[str], plain: str) -> dict[str, list[str]]:
    """Commands that take files, by name."""
    end = ["--model", MODEL, "--device", "cpu"]
    moved = ["--size", "64", "--stills", "2", "--film", "none"]
    return {
        "decompose": ["decompose", *pictures, *end, "--out", str(place / "apart")],
        "relight": ["relight", *pictures, *end, *moved, "--out", str(place / "relit")],
        "rotate": ["rotate", *pictures, *end, *moved, "--out", str(place / "turned")],
        "swap": ["swap", *pictures, *end, "--from", plain, "--size", "64", "--out", str(place / "mixed")],
        "mesh": ["mesh", *pictures, *end, "--out", str(place / "solid")],
    }


def uploads(hostile: Hostile) -> list[str]:
    """Send every file to a viewer; gives what was answered otherwise than is due."""
    import http.client
    from urllib.parse import urlsplit

    from derender.model import load
    from derender.report.viewer.app import Application, Viewer
    from derender.report.viewer.server import serving
    from derender.report.viewer.studio import Shelf, Studio

    faults = []
    with serving(Application(Viewer(Studio(load(MODEL), "m", Shelf(2))))) as url:
        server = urlsplit(url).netloc
        for file in (*hostile.readable, *hostile.unreadable):
            if not (hostile.folder / file).is_file():
                continue
            connection = http.client.HTTPConnection(server, timeout=60)
            body = (hostile.folder / file).read_bytes()
            connection.request(
                "POST", "/api/pictures", body, {"X-Derender-Page": "1", "Origin": f"http://{server}"}
            )
            status = connection.getresponse().status
            connection.close()
            if status not in ((200,) if file in hostile.readable else (413, 415)):
                faults.append(f"{file}: {status}")
    return faults
