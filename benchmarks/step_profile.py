"""Where the processor time of a training step goes on a CPU, by torch's profiler.

Shares are of self time of the operators on one thread, without LOOCC; the profiler's own cost is in them. The
speed of the whole step is measured without it, in processor time, and so is that of the fastest convolution,
forward and backward: a ceiling of what the same arithmetic can reach. FLOP are of convolutions and matrix
products, forward and backward. Images and VGG's weights are random.

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

RUNS = (
    ("paper", 64, 16, "32-true"), ("paper", 64, 16, "bf16-mixed"),
    ("small", 64, 16, "32-true"), ("small", 128, 16, "32-true"),
)  # fmt: skip
"""Preset, pixels, batch, precision of the networks."""
CONVOLUTIONS = ((64, 64, 3, 1), (128, 32, 3, 1), (256, 16, 3, 1), (64, 64, 4, 2), (256, 16, 4, 2))
"""Channels, pixels, kernel, stride: those of preset `paper` and of VGG that take longest."""
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


def measure(preset: str, size: int, batch: int, precision: str, steps: int) -> dict[str, Any]:
    images = torch.rand(batch, 3, size, size, generator=torch.Generator().manual_seed(0))
    _, step = step_of(preset, size, precision, training_step)
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
        "preset": preset, "size": size, "batch": batch, "precision": precision, "shares": shares,
        "gflop_per_image": gflop / batch, "gflop_per_cpu_s": gflop / least,
    }  # fmt: skip


def speed_of(dtype: torch.dtype, channels: int, pixels: int, kernel: int, stride: int) -> float:
    """GFLOP a processor second of one convolution, forward and backward, at batch 32; the best of eight."""
    layer = torch.nn.Conv2d(channels, channels, kernel, stride, 1, bias=False)
    layer = layer.to(dtype, memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    images = torch.rand(32, channels, pixels, pixels, dtype=dtype).to(memory_format=torch.channels_last)
    images.requires_grad_()
    slope = torch.ones_like(layer(images))
    gflop = 3 * 2 * layer.weight.numel() * 32 * slope.shape[-1] ** 2 / 1e9
    return gflop / min(seconds(lambda: layer(images).backward(slope), time.process_time) for _ in range(8))


def main() -> None:
    asks = parser(__doc__)
    asks.add_argument("--steps", type=int, default=5, help="profiled steps after two to warm up (default 5)")
    options = asks.parse_args()
    torch.set_num_threads(1)
    rows = [measure(*run, options.steps) for run in RUNS]
    for row in rows:
        print(", ".join(f"{key} {value}" for key, value in row.items()))
    kinds = {"32-true": torch.float32, "bf16-mixed": torch.bfloat16}
    ceilings = {name: max(speed_of(kind, *one) for one in CONVOLUTIONS) for name, kind in kinds.items()}
    print(ceilings)
    publish(
        {"benchmark": "step profile", "steps": options.steps, "fastest_convolution": ceilings, "rows": rows},
        options.json,
    )


if __name__ == "__main__":
    main()
