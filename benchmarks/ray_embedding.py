"""Embedding through Ray beside one process: the same table, a worker killed on the way, one worker and two.

Images are made up and lie in a folder; the model is the preset ``small`` with random weights. First the
tables must agree (bit for bit, as no image is unreadable or a copy), also after a worker was killed while
the run went on; then clocks run. Needs Ray: pip install 'derender[ray]'.

    python benchmarks/ray_embedding.py --count 2000 --json ray_embedding.json
"""

import argparse
import json
import os
import signal
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import ray
import torch
from machine import describe_machine
from PIL import Image

from derender.features import FeatureTable, embed_to_file
from derender.model import Derenderer

BATCH = 64


def made_up(folder: Path, count: int) -> None:
    """So many JPEGs of smooth noise."""
    generator = np.random.default_rng(0)
    for row in range(count):
        coarse = Image.fromarray(generator.integers(0, 256, (16, 16, 3), dtype=np.uint8))
        coarse.resize((64, 64), Image.Resampling.BICUBIC).save(folder / f"{row:06d}.jpg", quality=88)


def kill_a_worker(done: threading.Event, killed: list[int]) -> None:
    """End the process of an actor of this run, once, a second after it was first seen."""
    while not done.wait(0.5):
        mine = [pid for pid in descendants(os.getpid()) if b"MapWorker" in words_of(pid)]
        if mine:
            time.sleep(1)
            os.kill(mine[0], signal.SIGKILL)
            killed.append(mine[0])
            return


def descendants(parent: int) -> list[int]:
    """Every process that this one started, and theirs (Linux)."""
    try:
        tasks = Path(f"/proc/{parent}/task").iterdir()
        children = [int(pid) for task in tasks for pid in (task / "children").read_text().split()]
    except OSError:
        return []
    return [pid for child in children for pid in (child, *descendants(child))]


def words_of(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=2_000, help="images (default 2,000)")
    parser.add_argument("--json", type=Path, help="also write the numbers, machine and versions here")
    options = parser.parse_args()
    torch.set_num_threads(1)
    model = Derenderer.from_preset("small", seed=0).eval()
    ray.init(num_cpus=3, logging_level="ERROR", log_to_driver=False, include_dashboard=False)
    with tempfile.TemporaryDirectory() as name:
        pictures, tables = Path(name) / "pictures", Path(name)
        pictures.mkdir()
        made_up(pictures, options.count)

        def embed(path: Path, workers: int | None) -> float:
            began = time.perf_counter()
            engine = "local" if workers is None else "ray"
            embed_to_file(pictures, model, path, batch_size=BATCH, workers=workers or 1, engine=engine)
            return time.perf_counter() - began

        def check(path: Path) -> None:
            expected, found = FeatureTable.read(tables / "local.parquet"), FeatureTable.read(path)
            same = expected.files == found.files and all(
                np.array_equal(found.factors[factor], codes) for factor, codes in expected.factors.items()
            )
            if not same:
                raise SystemExit(f"{path.name} is another table than that of one process")

        seconds = {"one process": embed(tables / "local.parquet", None)}
        done, killed = threading.Event(), []
        killer = threading.Thread(target=kill_a_worker, args=(done, killed))
        killer.start()
        embed(tables / "killed.parquet", 2)
        done.set()
        killer.join()
        check(tables / "killed.parquet")
        print(f"the same table, though worker {killed} was killed" if killed else "no worker was killed")
        for workers in (1, 2):
            path = tables / f"ray{workers}.parquet"
            seconds[f"ray, {workers} workers"] = embed(path, workers)
            check(path)
    speeds = {way: options.count / taken for way, taken in seconds.items()}
    for way, speed in speeds.items():
        print(f"{way}: {speed:.1f} pictures/s, start of the workers included")
    if options.json is not None:
        result = {"benchmark": "ray embedding", "killed": len(killed), "pictures_per_second": speeds}
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps({**result, "machine": describe_machine()}, indent=1) + "\n")


if __name__ == "__main__":
    main()
