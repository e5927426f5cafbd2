"""Images per second of embedding beside training, and the memory that embedding takes at some sizes.

Speed: the same networks (preset paper) take turns at a training step (float32; networks in bfloat16), at
encoding images that are in memory, and at `derender embed`'s whole way from JPEGs in a tar to a parquet
file, both in float32. Before any clock runs, both ways of embedding must give the same numbers.
Memory: a model that computes next to nothing, and writes as many numbers as a real one, reads streams of
images that are made up as they are asked for, all different; each size runs in a process of its own, whose
highest resident memory is reported.

    python benchmarks/embedding.py --rounds 3 --json embedding.json
    python benchmarks/embedding.py --memory 10000 100000 500000
"""

import argparse
import io
import json
import os
import resource
import statistics
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from machine import parser, publish
from PIL import Image
from torch import nn
from training_step import CONFIG, OurStep, seconds

from derender.data import Sample, Stream, as_float, open_images
from derender.features import FeatureTable, embed_images
from derender.features.embedding import embed_to_file
from derender.model import Derenderer
from derender.objectives.perceptual import Vgg16Features

SIZE = 64
CODES = {"geometry": 256, "albedo": 256, "light": 256, "camera": 256}


class MadeUp(Stream):
    """Images of SIZE x SIZE that all differ, made when they are read."""

    layout = "made up"

    def __init__(self, count: int):
        self.source = f"{count} images"
        self.count = count
        self.pixels = np.random.default_rng(0).integers(0, 256, SIZE * SIZE * 3, dtype=np.uint8)

    def identity(self) -> object:
        return self.count

    def samples(self, start: int = 0) -> Iterator[Sample]:
        for row in range(start, self.count):
            yield Sample(f"{row:08d}.ppm", lambda row=row: self.encoded(row), (row + 1) / self.count)

    def encoded(self, row: int) -> bytes:
        pixels = self.pixels.copy()
        pixels[:8] = np.frombuffer(row.to_bytes(8, "little"), np.uint8)
        return f"P6 {SIZE} {SIZE} 255\n".encode() + pixels.tobytes()


class Idle(nn.Module):
    """Takes the first pixels for features: nothing to compute, as much to write as with real networks."""

    image_size = SIZE
    device = torch.device("cpu")

    def embed(self, images: torch.Tensor) -> dict[str, torch.Tensor]:
        flat = images.flatten(1)
        return {name: flat[:, :width].clone() for name, width in CODES.items()}


def shard_of(folder: Path, count: int) -> Path:
    """A tar of JPEGs of smooth noise, which are about as large as those of faces."""
    path = folder / "pictures.tar"
    generator = np.random.default_rng(0)
    with tarfile.open(path, "w") as tar:
        for row in range(count):
            coarse = Image.fromarray(generator.integers(0, 256, (16, 16, 3), dtype=np.uint8))
            buffer = io.BytesIO()
            coarse.resize((SIZE, SIZE), Image.Resampling.BICUBIC).save(buffer, "JPEG", quality=88)
            info = tarfile.TarInfo(f"{row:06d}.jpg")
            info.size = buffer.tell()
            buffer.seek(0)
            tar.addfile(info, buffer)
    return path


def measure_speed(
    batch: int, count: int, rounds: int, clock: Callable[[], float]
) -> dict[str, dict[str, float]]:
    """Images per second of each way: median, least and most of the rounds after one to warm up."""
    torch.manual_seed(0)
    halved = OurStep(Derenderer(CONFIG.model), Vgg16Features(), "bf16-mixed")
    trained = OurStep(Derenderer(CONFIG.model), Vgg16Features(), "32-true")
    model = Derenderer(CONFIG.model)
    images = np.random.default_rng(0).integers(0, 256, (count, 3, SIZE, SIZE), dtype=np.uint8)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shard, table = shard_of(folder, count), folder / "features.parquet"

        def whole_way() -> None:
            embed_to_file(shard, model, table)

        whole_way()
        with open_images(shard) as stream:
            sample = next(iter(stream.samples())).read()
        first = np.asarray(Image.open(io.BytesIO(sample))).transpose(2, 0, 1)[None]
        expected = embed_images(model, np.ascontiguousarray(first))
        written = FeatureTable.read(table)
        for factor, codes in expected.items():
            difference = float(np.abs(written.factors[factor][:1] - codes).max())
            if difference > 1e-4 * max(1.0, float(np.abs(codes).max())):
                raise SystemExit(f"the two ways of embedding disagree by {difference:.1e} in {factor}")
        ways: dict[str, tuple[Callable[[], object], int]] = {
            "training step": (lambda: trained.step(as_float(images[:batch])), batch),
            "training step, bfloat16": (lambda: halved.step(as_float(images[:batch])), batch),
            "encoders alone": (lambda: embed_images(model, images), count),
            "derender embed, tar to parquet": (whole_way, count),
        }
        speeds: dict[str, list[float]] = {way: [] for way in ways}
        for number in range(rounds + 1):
            for way, (work, pictures) in ways.items():
                speed = pictures / seconds(work, clock)
                if number:
                    speeds[way].append(speed)
    return {
        way: {"median": statistics.median(values), "least": min(values), "most": max(values)}
        for way, values in speeds.items()
    }


def measure_memory(count: int) -> dict[str, float]:
    """Embed so many images in this process; its highest resident memory before and after, in MB."""
    with tempfile.TemporaryDirectory() as name:
        embed_to_file(MadeUp(600), Idle(), Path(name) / "warm.parquet", workers=2)
        before = peak_mb()
        table = Path(name) / "t.parquet"
        took = seconds(lambda: embed_to_file(MadeUp(count), Idle(), table, workers=2))
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return {
        "pictures": count,
        "before_mb": before,
        "peak_mb": peak_mb(),
        "pictures_per_second": count / took,
        "cpu_seconds": usage.ru_utime + usage.ru_stime,
    }


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)


def in_a_process_of_its_own(count: int) -> dict[str, float]:
    said = subprocess.run(
        [sys.executable, __file__, "--one-size", str(count)], capture_output=True, text=True, check=True
    )
    return json.loads(said.stdout)


def main() -> None:
    asks = parser(__doc__)
    asks.add_argument("--batch", type=int, default=64, help="images in a training step (default 64)")
    asks.add_argument("--count", type=int, default=1024, help="images to embed (default 1024)")
    asks.add_argument("--rounds", type=int, default=3, help="timed rounds after one to warm up (default 3)")
    asks.add_argument("--threads", type=int, default=os.cpu_count(), help="torch's threads")
    asks.add_argument(
        "--memory", type=int, nargs="+", metavar="N", help="measure memory at these sizes instead"
    )
    asks.add_argument("--cpu", action="store_true", help="count seconds of the processor: a busy machine")
    asks.add_argument("--one-size", type=int, help=argparse.SUPPRESS)
    options = asks.parse_args()
    torch.set_num_threads(options.threads)
    if options.one_size is not None:
        print(json.dumps(measure_memory(options.one_size)))
        return
    result: dict[str, object]
    if options.memory is not None:
        rows = [in_a_process_of_its_own(count) for count in options.memory]
        for row in rows:
            print(", ".join(f"{name} {value:,.0f}" for name, value in row.items()))
        result = {"benchmark": "embedding memory", "rows": rows}
    else:
        clock = time.process_time if options.cpu else time.perf_counter
        speeds = measure_speed(options.batch, options.count, options.rounds, clock)
        base = speeds["training step"]["median"]
        for way, speed in speeds.items():
            least, most = speed["least"], speed["most"]
            told = f"{speed['median']:.1f} pictures/s ({least:.1f}..{most:.1f})"
            print(f"| {way} | {told} | {speed['median'] / base:.1f}x |")
        result = {
            "benchmark": "embedding", "rounds": options.rounds, "speeds": speeds,
            "clock": "processor" if options.cpu else "wall",
            "against_training": {way: speed["median"] / base for way, speed in speeds.items()},
        }  # fmt: skip
    publish(result, options.json)


if __name__ == "__main__":
    main()
