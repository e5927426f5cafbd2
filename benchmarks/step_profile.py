"""Where the processor time of a training step goes on a CPU, by torch's profiler.

Shares are of self time of the operators on one thread, in float32 without LOOCC; the profiler's own cost is
in them. The speed of the whole step and of a large matrix product is measured without it, in processor time.
FLOP are of convolutions and matrix products, forward and backward. Images and VGG's weights are random.

    python benchmarks/step_profile.py --json benchmarks/results/step_profile.json
"""

import time
from collections import Counter
from functools import partial
from typing import Any

import torch
from compiled_step import step_of
from machine import parser, publish
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode
from training_step import seconds

from derender.training.process import freed_memory_kept
from derender.training.step import training_step

RUNS = (("paper", 64, 16), ("small", 64, 16), ("small", 128, 16))
"""Preset, pixels, batch."""
GROUPS = {
    "convolution_backward": "convolutions, backward", "convolutionbackward": "convolutions, backward",
    "convolution": "convolutions, forward", "group_norm": "group norm", "adam": "Adam",
    "derender": "warp and shade (Numba)", "copy_": "copies and layout", "clone": "copies and layout",
    "contiguous": "copies and layout", "cat": "copies and layout", "fill_": "copies and layout",
    "zero_": "copies and layout",
}  # fmt: skip
REST = "elementwise, losses, rest"


def group_of(operator: str) -> str:
    """The row of the table in which an operator counts."""
    return next((group for part, group in GROUPS.items() if part in operator), REST)


def measure(preset: str, size: int, batch: int, steps: int) -> dict[str, Any]:
    images = torch.rand(batch, 3, size, size, generator=torch.Generator().manual_seed(0))
    _, step = step_of(preset, size, "32-true", training_step)
    with freed_memory_kept(torch.device("cpu")):
        step(images)
        with FlopCounterMode(display=False) as counted:
            step(images)
        least = min(seconds(partial(step, images), time.process_time) for _ in range(steps))
        with profile(activities=[ProfilerActivity.CPU]) as watched:
            for _ in range(steps):
                step(images)
    spent: Counter[str] = Counter()
    for operator in watched.key_averages():
        spent[group_of(operator.key.lower())] += operator.self_cpu_time_total
    gflop = counted.get_total_flops() / 1e9
    shares = {name: part / spent.total() for name, part in spent.items()}
    return {
        "preset": preset, "size": size, "batch": batch, "gflop_per_image": gflop / batch,
        "gflop_per_cpu_s": gflop / least, "shares": shares,
    }  # fmt: skip


def product(side: int = 2048) -> float:
    """GFLOP a processor second of one large matrix product: what the step could reach at most."""
    square = torch.rand(side, side)
    return (
        2
        * side**3
        / 1e9
        / min(seconds(lambda: torch.mm(square, square).sum().item(), time.process_time) for _ in range(5))
    )


def main() -> None:
    asks = parser(__doc__)
    asks.add_argument("--steps", type=int, default=5, help="profiled steps after two to warm up (default 5)")
    options = asks.parse_args()
    torch.set_num_threads(1)
    rows = [measure(*run, options.steps) for run in RUNS]
    for row in rows:
        print(", ".join(f"{key} {value}" for key, value in row.items()))
    publish(
        {"benchmark": "step profile", "steps": options.steps, "matrix_product": product(), "rows": rows},
        options.json,
    )


if __name__ == "__main__":
    main()
