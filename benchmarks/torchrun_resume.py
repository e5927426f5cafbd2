"""A real torchrun: two processes train, then one or two go on; the curves must be those of one process.

Images are made up, the model is tiny, all on the CPU (gloo). Four runs: one process all the way; two
processes that stop half-way; a copy of that run gone on with by one process, another by two. Every loss that
was logged must agree. Times are given, start of the processes included; they say little on a shared machine.

    python benchmarks/torchrun_resume.py --json benchmarks/results/torchrun_resume.json
"""

import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from machine import parser, publish
from PIL import Image

from derender.training.run_folder import read_metrics

SETTINGS = (
    *("image_size=32", "width=8", "light_width=4", "batch_size=8", "perceptual=none", "loocc=light+camera"),
    *("validate_every=32", "checkpoint_every=32", "sample_every=100000", "learning_rate=1e-4"),
    *("warmup_images=0", "final_rate=1", "whitening.pictures=0"),
)
NOT_COMPARED = {"kind", "images", "seconds", "images_per_second", "waiting"}
TOLERANCE = 2e-3  # Adam's first steps have the size of the rate however small a gradient is


def made_up(folder: Path, count: int) -> None:
    noise = np.random.default_rng(0)
    folder.mkdir()
    for number in range(count):
        pixels = noise.integers(0, 256, (4, 4, 3), dtype=np.uint8).repeat(8, axis=0).repeat(8, axis=1)
        Image.fromarray(pixels).save(folder / f"{number:03d}.png")


def train(processes: int, pictures: Path, run: Path, images: int, *more: str) -> float:
    """Seconds that the command took; a failure ends everything with what it said."""
    launcher = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(processes)]
    command = [sys.executable, *(launcher if processes > 1 else []), "-m", "derender", "train"]
    command += ["--data", str(pictures), "--preset", "small", "--device", "cpu", "--out", str(run), *more]
    command += [part for one in (*SETTINGS, f"images={images}") for part in ("--set", one)]
    threads = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    began = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, **threads}, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)} failed:\n{done.stdout}{done.stderr}")
    return time.perf_counter() - began


def largest_difference(run: Path, expected: Path) -> float:
    """Of any logged number, relative to the larger of its size and a tenth."""
    rows, same = read_metrics(run), read_metrics(expected)
    if [(row["kind"], row["images"]) for row in rows] != [(row["kind"], row["images"]) for row in same]:
        raise SystemExit(f"{run.name} logged at other places than {expected.name}")
    return max(
        abs(row[name] - other[name]) / max(abs(other[name]), 0.1)
        for row, other in zip(rows, same, strict=True)
        for name in other.keys() - NOT_COMPARED
        if isinstance(other[name], float) and math.isfinite(other[name])
    )


def main() -> None:
    asks = parser(__doc__)
    asks.add_argument("--images", type=int, default=64, help="images shown before the resume; as many after")
    options = asks.parse_args()
    seconds: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        pictures, alone, shared = root / "pictures", root / "alone", root / "shared"
        made_up(pictures, 40)
        # the half-way stop, too, so that learning rate and log lines are the same everywhere
        seconds["one process"] = train(1, pictures, alone, options.images)
        seconds["one process, resumed"] = train(1, pictures, alone, 2 * options.images, "--resume")
        seconds["two processes"] = train(2, pictures, shared, options.images)
        apart = {}
        for processes in (1, 2):
            run = root / f"resumed{processes}"
            shutil.copytree(shared, run)
            way = f"two processes, resumed on {processes}"
            seconds[way] = train(processes, pictures, run, 2 * options.images, "--resume")
            apart[way] = largest_difference(run, alone)
    for way, difference in apart.items():
        print(f"{way}: logged numbers differ from those of one process by {difference:.1e} at most")
    for way, taken in seconds.items():
        print(f"{way}: {taken:.1f} s")
    result = {"benchmark": "torchrun and resume", "differences": apart, "seconds": seconds}
    publish(result, options.json)
    if max(apart.values()) > TOLERANCE:
        raise SystemExit(f"more than {TOLERANCE}: these are not the same run")


if __name__ == "__main__":
    main()
