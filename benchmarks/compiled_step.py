"""The training step under torch.compile beside the step as the loop runs it, in processor time on a CPU.

Before any clock runs both must give the same loss and gradients (float32: 1e-4 and 1e-2 of the norm; bfloat16
rounds at other places: 2e-2 and 0.2). Then they take turns; each ratio is of one round. Compiling counts with
its C++ compiler and an empty cache. Images and VGG's weights are random: neither changes the work.

    python benchmarks/compiled_step.py --json benchmarks/results/compiled_step.json
"""

import os
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from machine import parser, publish
from torch import Tensor
from training_step import seconds

from derender.model import Derenderer
from derender.objectives.perceptual import Vgg16Features
from derender.objectives.self_features import SelfFeatures
from derender.training.config import resolve
from derender.training.process import freed_memory_kept
from derender.training.step import training_step
from derender.training.task import network_precision

RUNS = (
    ("small", 64, 16, "32-true"),
    ("paper", 64, 16, "32-true"),
    ("small", 64, 16, "bf16-mixed"),
    ("small", 128, 16, "32-true"),
)
"""Preset, pixels, batch, precision of the networks."""
TOLERANCES = {"32-true": (1e-4, 1e-2), "bf16-mixed": (2e-2, 0.2)}


def step_of(name: str, size: int, precision: str, losses: Any) -> tuple[Any, Callable[..., Any]]:
    """A fresh model, and its step on a batch by this function of losses; ``update`` is whether Adam moves."""
    config = resolve(name, [f"image_size={size}"])
    model = Derenderer.seeded(config.model, 0).to(memory_format=torch.channels_last)
    torch.manual_seed(0)
    features = Vgg16Features() if config.objective.perceptual == "vgg16" else SelfFeatures()
    features.requires_grad_(False).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    optimiser = torch.optim.Adam(model.parameters(), lr=1e-5, fused=True)
    noise, context = torch.Generator().manual_seed(0), network_precision(precision, model.device)

    def step(images: Tensor, update: bool = True) -> float:
        total = losses(model, images, config.objective, features, noise, context).total
        total.backward()
        if update:
            optimiser.step()
            optimiser.zero_grad(set_to_none=True)
        return total.item()

    return model, step


def with_children(work: Callable[[], Any]) -> float:
    """Processor time of this process and of those that it waits for, such as a compiler; to 10 ms."""
    began = os.times()
    work()
    return sum(os.times()[:4]) - sum(began[:4])


def measure(name: str, size: int, batch: int, precision: str, rounds: int) -> dict[str, Any]:
    torch._dynamo.reset()
    images = torch.rand(batch, 3, size, size, generator=torch.Generator().manual_seed(0))
    ours, eager = step_of(name, size, precision, training_step)
    other, compiled = step_of(name, size, precision, torch.compile(training_step))
    result: list[float] = []
    warming = with_children(lambda: result.append(compiled(images, False)))
    loss = eager(images, False)
    apart = abs(result[0] / loss - 1)
    mine, others = (torch.cat([p.grad.flatten() for p in m.parameters()]) for m in (ours, other))
    gradient = ((mine - others).norm() / mine.norm()).item()
    most = TOLERANCES[precision]
    if apart > most[0] or gradient > most[1]:
        raise SystemExit(f"{name}, {size} px: losses differ by {apart:.1e}, gradients by {gradient:.1e}")
    taken: dict[str, list[float]] = {"eager": [], "compiled": []}
    with freed_memory_kept(torch.device("cpu")):
        for turn in range(rounds + 1):
            for way, step in (("eager", eager), ("compiled", compiled)):
                step(images)
                least = min(seconds(partial(step, images), time.process_time) for _ in range(3))
                if turn:
                    taken[way].append(least)
    ratios = sorted(a / b for a, b in zip(taken["eager"], taken["compiled"], strict=True))
    return {
        "preset": name, "size": size, "batch": batch, "precision": precision,
        "loss_difference": apart, "gradient_difference": gradient, "compiling_cpu_s": round(warming, 1),
        "eager_ms": round(1e3 * statistics.median(taken["eager"]), 1),
        "compiled_ms": round(1e3 * statistics.median(taken["compiled"]), 1),
        "ratio": statistics.median(ratios), "least": ratios[0], "most": ratios[-1],
    }  # fmt: skip


def main() -> None:
    asks = parser(__doc__)
    asks.add_argument("--rounds", type=int, default=7, help="timed rounds after one to warm up (default 7)")
    asks.add_argument("--only", type=int, nargs="*", help="numbers of the runs, from 0 (default: all)")
    options = asks.parse_args()
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore", "Dynamo detected a call to a `functools.lru_cache`")
    torch._logging.set_logs(dynamo=40)  # each break of the graph is a warning
    rows = []
    with tempfile.TemporaryDirectory() as cache:
        os.environ |= {"TORCHINDUCTOR_CACHE_DIR": cache, "TORCHINDUCTOR_COMPILE_THREADS": "1"}
        for number, run in enumerate(RUNS):
            if options.only is None or number in options.only:
                rows.append(measure(*run, options.rounds))
                print(", ".join(f"{key} {value}" for key, value in rows[-1].items()), flush=True)
                publish({"benchmark": "compiled step", "rounds": options.rounds, "rows": rows}, options.json)


if __name__ == "__main__":
    main()
