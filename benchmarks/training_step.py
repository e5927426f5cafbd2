"""Images per second of derender's training step beside the official step's arithmetic done literally.

Before any clock runs, both steps get the same weights and must give the same loss (1e-5 relative, float32)
and the same gradients (1e-2 of each tensor's norm: where rounding moves a ReLU or a bilinear cell across an
edge, the literal step differs from itself in another memory format by a few 1e-3). Then they take turns, so
that a busy moment of the machine hits all of them; ratios come from medians over rounds. Images and VGG's
weights are random: neither changes the work.

    python benchmarks/training_step.py --rounds 5 --json training_step.json
"""

import os
import statistics
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from functools import partial

import torch
from literal.networks import Vgg16
from literal.step import NETS, LiteralStep
from machine import parser, publish
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from derender.model import Derenderer
from derender.objectives.perceptual import Vgg16Features
from derender.training.config import resolve
from derender.training.process import freed_memory_kept
from derender.training.step import training_step
from derender.training.task import network_precision

CONFIG = resolve("paper")
LOSS_TOLERANCE = 1e-5
GRADIENT_TOLERANCE = 1e-2


class OurStep:
    """What derender's training loop does with one batch, at one precision."""

    def __init__(self, model: Derenderer, vgg: Vgg16Features, precision: str):
        self.model = model.to(memory_format=torch.channels_last)
        self.vgg = vgg.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        self.precision = network_precision(precision, model.device)
        self.generator = torch.Generator().manual_seed(0)
        settings = CONFIG.optimiser
        self.optimiser = torch.optim.Adam(
            model.parameters(), lr=settings.learning_rate, betas=settings.betas,
            weight_decay=settings.weight_decay, fused=True,
        )  # fmt: skip

    def loss(self, images: Tensor) -> Tensor:
        return training_step(
            self.model, images, CONFIG.objective, self.vgg, self.generator, self.precision
        ).total

    def step(self, images: Tensor) -> float:
        loss = self.loss(images)
        loss.backward()
        self.optimiser.step()
        self.optimiser.zero_grad(set_to_none=True)
        return loss.item()


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        name: which step.
        images_per_second: median over rounds.
        spread: slowest and fastest round.
        ratio: median speed over that of the literal step.
        gflop_per_image: of convolutions and matrix products, forward and backward.
    """

    name: str
    images_per_second: float
    spread: tuple[float, float]
    ratio: float
    gflop_per_image: float


def same_start(literal: LiteralStep, model: Derenderer) -> None:
    """Give derender's networks the literal step's weights, tensor by tensor."""
    with torch.no_grad():
        for name in NETS:
            pairs = zip(getattr(literal, name).parameters(), model.nets[name].parameters(), strict=True)
            for source, target in pairs:
                target.copy_(source.view(target.shape))


def same_vgg(literal: Vgg16) -> Vgg16Features:
    """derender's VGG with the literal one's weights up to relu3_3, uncalibrated."""
    vgg = Vgg16Features()
    with torch.no_grad():
        for source, target in zip(literal.to_relu3_3.parameters(), vgg.features.parameters(), strict=True):
            target.copy_(source)
    return vgg


def our_step(literal: LiteralStep, precision: str) -> OurStep:
    model = Derenderer(CONFIG.model)
    same_start(literal, model)
    return OurStep(model, same_vgg(literal.vgg), precision)


def check_agreement(literal: LiteralStep, ours: OurStep, images: Tensor) -> tuple[float, float]:
    """Relative difference of the losses, and the largest of any gradient's; too large is an error."""
    expected, got = literal.loss(images), ours.loss(images)
    expected.backward()
    got.backward()
    loss_difference = abs(got.item() - expected.item()) / abs(expected.item())
    gradient_difference = 0.0
    for name in NETS:
        for a, b in zip(getattr(literal, name).parameters(), ours.model.nets[name].parameters(), strict=True):
            assert a.grad is not None and b.grad is not None
            difference = (a.grad.view(b.shape) - b.grad).norm() / a.grad.norm().clamp(min=1e-12)
            gradient_difference = max(gradient_difference, difference.item())
    for module in (literal, ours.model):
        module.zero_grad(set_to_none=True)
    if loss_difference > LOSS_TOLERANCE or gradient_difference > GRADIENT_TOLERANCE:
        raise SystemExit(
            f"the two steps disagree: losses {expected.item():.7f} and {got.item():.7f} differ by "
            f"{loss_difference:.1e}, gradients by {gradient_difference:.1e} of a norm; nothing was timed"
        )
    return loss_difference, gradient_difference


def gflop_per_image(loss: Callable[[Tensor], Tensor], images: Tensor) -> float:
    with FlopCounterMode(display=False) as counter:
        loss(images).backward()
    return counter.get_total_flops() / len(images) / 1e9


def seconds(work: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    """How long it takes by the clock on the wall; ``time.process_time`` says how much of the processor."""
    began = clock()
    work()
    return clock() - began


def measure(
    steps: dict[str, LiteralStep | OurStep], images: Tensor, rounds: int, clock: Callable[[], float]
) -> list[Row]:
    """Let the steps take turns: two steps each, of which the second counts; the first round warms up."""
    speeds: dict[str, list[float]] = {name: [] for name in steps}
    for round_number in range(rounds + 1):
        for name, step in steps.items():
            # the loop keeps freed memory from step to step; the literal step runs with the default allocator
            with freed_memory_kept(torch.device("cpu")) if isinstance(step, OurStep) else nullcontext():
                step.step(images)
                speed = len(images) / seconds(partial(step.step, images), clock)
            if round_number > 0:
                speeds[name].append(speed)
    medians = {name: statistics.median(values) for name, values in speeds.items()}
    base = medians[next(iter(steps))]
    return [
        Row(
            name, medians[name], (min(speeds[name]), max(speeds[name])), medians[name] / base,
            gflop_per_image(steps[name].loss, images[:2]),
        )
        for name in steps
    ]  # fmt: skip


def table(rows: list[Row]) -> str:
    lines = [
        "| step | images/s | slowest..fastest | against literal | GFLOP an image |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        slowest, fastest = row.spread
        lines.append(
            f"| {row.name} | {row.images_per_second:.2f} | {slowest:.2f}..{fastest:.2f} "
            f"| {row.ratio:.2f}x | {row.gflop_per_image:.1f} |"
        )
    return "\n".join(lines)


def main() -> None:
    asks = parser(__doc__)
    asks.add_argument("--batch", type=int, default=64, help="images in a batch (default 64)")
    asks.add_argument("--rounds", type=int, default=5, help="timed rounds after one to warm up (default 5)")
    asks.add_argument(
        "--threads", type=int, default=os.cpu_count(), help="torch's threads (default: every core)"
    )
    asks.add_argument("--no-bf16", action="store_true", help="leave the bfloat16 row out")
    asks.add_argument("--cpu", action="store_true", help="measure processor time, on a busy machine")
    asks.add_argument("--check-only", action="store_true", help="compare losses and gradients, time nothing")
    options = asks.parse_args()

    torch.set_num_threads(options.threads)
    torch.manual_seed(0)
    images = torch.rand(options.batch, 3, 64, 64)
    literal = LiteralStep()
    ours = our_step(literal, "32-true")
    loss_difference, gradient_difference = check_agreement(literal, ours, images[:4])
    print(f"losses agree to {loss_difference:.1e}, gradients to {gradient_difference:.1e} of each norm")
    if options.check_only:
        return
    steps: dict[str, LiteralStep | OurStep] = {"literal, float32": literal, "derender, float32": ours}
    if not options.no_bf16:
        steps["derender, bfloat16 networks"] = our_step(literal, "bf16-mixed")
    clock = time.process_time if options.cpu else time.perf_counter
    rows = measure(steps, images, options.rounds, clock)
    print(table(rows))
    result = {
        "benchmark": "training_step", "batch": options.batch, "rounds": options.rounds,
        "clock": "processor" if options.cpu else "wall",
        "loss_difference": loss_difference, "gradient_difference": gradient_difference,
        "rows": [asdict(row) for row in rows],
    }  # fmt: skip
    publish(result, options.json)


if __name__ == "__main__":
    main()
