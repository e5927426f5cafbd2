"""Trains, embeds and serves in one process for a while, and tells whether anything grows.

    python tests/trust/soak.py --minutes 60 --clients 8 --json soak.json

A small model is trained again and again, a folder is embedded, and clients open images on a viewer and drag
its light; memory, descriptors, threads and files are sampled. The first quarter warms up. A quantity grows if
its median in the last quarter exceeds that of the second by more than its bound. Linux only.
"""

import http.client
import json
import os
import re
import sys
import tempfile
import threading
import time
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
from kills import made_material
from tests.report.viewer.serving import serving

from derender.features.embedding import embed_to_file
from derender.learn import train
from derender.model import load
from derender.report.viewer.app import Application
from derender.report.viewer.studio import Shelf, Studio

BOUNDS = {"private_mb": (20.0, 0.03), "descriptors": (4.0, 0.0), "threads": (2.0, 0.0), "files": (2.0, 0.0)}
"""How much more there may be in the end: so much, or this share of what there was, whichever is larger."""

SAMPLES_AT_LEAST = 8
LEARNS = ["image_size=32", "width=8", "light_width=4", "batch_size=8", "images=64", "perceptual=none"]


def grown(values: Sequence[float], bound: tuple[float, float]) -> float:
    """By how much the last quarter's median exceeds what the second's allows; 0 or less is flat."""
    if len(values) < SAMPLES_AT_LEAST:
        raise ValueError(f"{len(values)} samples tell nothing: soak for longer, or sample more often")
    _, second, _, last = np.array_split(np.asarray(values), 4)
    before = float(np.median(second))
    return float(np.median(last)) - before - max(bound[0], bound[1] * before)


def measured(place: Path) -> dict[str, float]:
    """What this process holds now, and the files of its folder."""
    told = Path("/proc/self/smaps_rollup").read_text() + Path("/proc/self/status").read_text()
    numbers = dict(re.findall(r"^(\w+):\s+(\d+)", told, re.MULTILINE))
    return {
        "private_mb": int(numbers["Anonymous"]) / 1024,
        "descriptors": float(len(list(Path("/proc/self/fd").iterdir()))),
        "threads": float(numbers["Threads"]),
        "files": float(sum(len(names) for _, _, names in os.walk(place))),
    }


def visit(url: str, image: bytes, done: Counter[str]) -> None:
    """Open the page and an image, drag the light; an answer that is not due is an error."""
    line = http.client.HTTPConnection(urlsplit(url).netloc, timeout=60)

    def ask(path: str, body: bytes | None = None) -> bytes:
        headers = {"X-Derender-Page": "1", "Origin": url.rstrip("/")}
        line.request("GET" if body is None else "POST", path, body, headers)
        answer = line.getresponse()
        content = answer.read()
        if answer.status != 200:
            raise RuntimeError(f"{path}: {answer.status} {content[:200]!r}")
        return content

    ask("/")
    picture = json.loads(ask("/api/pictures", image))["picture"]
    for yaw in range(-60, 61, 20):
        light = {"ambient": 0.3, "diffuse": 0.7, "pitch_deg": 0, "yaw_deg": yaw}
        camera = {"rotation_deg": [0, 0, 0], "translation": [0, 0, 0]}
        view = {"picture": picture, "swaps": {}, "light": light, "camera": camera}
        ask("/api/view", json.dumps(view).encode())
        done["views"] += 1
    line.close()


def soak(place: Path, minutes: float, clients: int, every_seconds: float, model: str) -> dict[str, object]:
    """Keep all three at work for so long; gives series, counts and faults."""
    words, net, done, faults, stop = made_material(place, 60), load(model), Counter(), [], threading.Event()
    data, image = Path(words["DATA"]), Path(words["PHOTO"]).read_bytes()

    def again(name: str, work: Callable[[], object]) -> None:
        while not stop.is_set():
            try:
                work()
                done[name] += 1
            except Exception as problem:
                faults.append(f"{name}: {type(problem).__name__} {problem}")
                return

    def trained() -> None:
        with tempfile.TemporaryDirectory() as run:
            out = Path(run) / "run"
            train(data, out=out, preset="small", settings=LEARNS, device="cpu", page=False)

    series: dict[str, list[float]] = {name: [] for name in BOUNDS}
    with serving(Application(Studio(net, "m", Shelf(8)))) as url:
        works = [lambda: visit(url, image, done)] * clients
        works += [trained, lambda: embed_to_file(data, net, place / "F.parquet", fresh=True)]
        names = [*["visits"] * clients, "trainings", "tables"]
        pairs = zip(names, works, strict=True)
        threads = [threading.Thread(target=again, args=pair, daemon=True) for pair in pairs]
        for thread in threads:
            thread.start()
        until = time.monotonic() + 60 * minutes
        while time.monotonic() < until and not faults:
            stop.wait(every_seconds)
            for name, value in measured(place).items():
                series[name].append(value)
        stop.set()
        for thread in threads:
            thread.join(300)
    grows = {name: grown(values, BOUNDS[name]) for name, values in series.items()}
    faults += [f"{name} grows by {more:.1f} too much" for name, more in grows.items() if more > 0]
    return {"minutes": minutes, "clients": clients, "counts": done, "series": series, "faults": faults}


if __name__ == "__main__":
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--clients", type=int, default=8)
    parser.add_argument("--every", type=float, default=5.0, help="seconds between samples")
    parser.add_argument("--model", default="rendered-faces-64")
    parser.add_argument("--json", type=Path, help="file for all samples")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="derender-soak-") as folder:
        told = soak(Path(folder), asked.minutes, asked.clients, asked.every, asked.model)
    if asked.json:
        asked.json.write_text(json.dumps(told) + "\n")
    print(json.dumps({name: value for name, value in told.items() if name != "series"}, indent=1))
    sys.exit(1 if told["faults"] else 0)
