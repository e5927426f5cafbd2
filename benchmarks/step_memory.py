"""Highest resident memory of one training step, whole and in chunks (setting ``accumulate``), on a CPU.

Each row runs in a process of its own: preset, LOOCC over light and camera, VGG's layers with random weights,
one step (losses, gradients, Adam), and what the process held before it taken off. Losses and the norm of the
gradient must agree for all numbers of chunks: LOOCC's negatives are those of the whole batch.

    python benchmarks/step_memory.py --sizes 64 128 256 --batch 32 --chunks 1 4 16
"""

import argparse
import json
import resource
import subprocess
import sys
import time

import torch
from machine import parser, publish

from derender.model import Derenderer
from derender.objectives.perceptual import Vgg16Features
from derender.training.config import resolve
from derender.training.step import training_step

TOLERANCE = 1e-4
GRADIENT_TOLERANCE = 1e-2  # rounding moves a rectifier or a bilinear cell across an edge here and there


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)


def one_step(preset: str, size: int, batch: int, chunks: int) -> dict[str, float | str]:
    """The loss of one step, its highest memory in MB above what was held before, and its CPU seconds."""
    config = resolve(preset, [f"image_size={size}", "loocc=light+camera"])
    model = Derenderer.seeded(config.model, 0).to(memory_format=torch.channels_last)
    torch.manual_seed(0)
    vgg = Vgg16Features().to(memory_format=torch.channels_last)
    optimiser = torch.optim.Adam(model.parameters(), fused=True)
    images = torch.rand(batch, 3, size, size, generator=torch.Generator().manual_seed(0))
    noise = torch.Generator().manual_seed(0)
    before, began = peak_mb(), time.process_time()
    loss = training_step(model, images, config.objective, vgg, noise, chunks=chunks).total
    loss.backward()
    squares = [float(one.grad.double().square().sum()) for one in model.parameters() if one.grad is not None]
    optimiser.step()
    return {
        "preset": preset,
        "size": size,
        "batch": batch,
        "chunks": chunks,
        "loss": loss.item(),
        "gradient_norm": sum(squares) ** 0.5,
        "before_mb": before,
        "step_mb": peak_mb() - before,
        "mb_per_picture": (peak_mb() - before) / batch,
        "cpu_seconds": time.process_time() - began,
    }


def main() -> None:
    asks = parser(__doc__)
    asks.add_argument("--preset", default="paper")
    asks.add_argument("--sizes", type=int, nargs="+", default=[64, 128, 256], help="pixels")
    asks.add_argument("--batch", type=int, default=32)
    asks.add_argument("--chunks", type=int, nargs="+", default=[1, 4, 16])
    asks.add_argument("--one", type=int, help=argparse.SUPPRESS)
    options = asks.parse_args()
    if options.one is not None:
        print(json.dumps(one_step(options.preset, options.sizes[0], options.batch, options.one)))
        return
    rows = []
    for size in options.sizes:
        first = len(rows)
        for chunks in options.chunks:
            sizes = ["--preset", options.preset, "--sizes", str(size), "--batch", str(options.batch)]
            command = [sys.executable, __file__, *sizes, "--one", str(chunks)]
            said = subprocess.run(command, capture_output=True, text=True, check=True)
            rows.append(json.loads(said.stdout))
            print(", ".join(f"{name} {value}" for name, value in rows[-1].items()), flush=True)
        for name, allowed in (("loss", TOLERANCE), ("gradient_norm", GRADIENT_TOLERANCE)):
            apart = max(abs(row[name] / rows[first][name] - 1) for row in rows[first:])
            if apart > allowed:
                raise SystemExit(f"{size} pixels: {name} differs by {apart:.1e}: the numbers say nothing")
    publish({"benchmark": "step memory", "rows": rows}, options.json)


if __name__ == "__main__":
    main()
