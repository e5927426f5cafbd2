"""Trains the same tiny model in several ways of computing and tells how far they drift apart.

    python tests/trust/agreement.py --steps 200

float32 with the numba kernels is what the others are held against: float32 with the plain torch kernels
(other sums, same definition), networks in bfloat16, and networks through torch.compile: traced only
(``aot_eager``), and as compiled machine code (``inductor``) where a C++ compiler is found. The same weights,
images and perturbations go into each; a training is chaotic, so what must agree stands in ``WAYS``.
"""

import argparse
import os
import shutil
import sys
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from derender.data.synthetic import faces
from derender.model import Derenderer
from derender.render import render_scene
from derender.renderers import as_renderer
from derender.training.batches import random_stream
from derender.training.config import ObjectiveSettings
from derender.training.step import training_step

SIZE, BATCH, PICTURES = 32, 4, 64
PROGRAMS = 64
"""So many may be compiled of one ``forward``, which several networks share; torch leaves out the rest."""
OBJECTIVE = ObjectiveSettings(perceptual="none", loocc="light+camera")


@dataclass(frozen=True)
class Way:
    """One way of computing a step.

    Attributes:
        name: of the way.
        first, end: how far, relative, the L1 may be of the first step and of the mean of the last tenth.
        backend: of the renderer.
        bf16: whether networks compute in bfloat16.
        compiled: the backend of torch.compile for every encoder and decoder, "" for none.
    """

    name: str
    first: float = 1e-5
    end: float = 0.02
    backend: str = "numba"
    bf16: bool = False
    compiled: str = ""


FLOAT32 = Way("float32, numba")
WAYS = (
    Way("float32, reference", backend="reference"),
    Way("bf16, numba", 0.02, 0.10, bf16=True),
    Way("float32, compiled", compiled="aot_eager"),
    Way("float32, machine code", compiled="inductor"),
)


def course(way: Way, steps: int, seed: int = 0) -> Tensor:
    """Train for some steps; the L1 of each."""
    pictures = torch.from_numpy(faces.generate(PICTURES, image_size=SIZE, seed=seed).images).float() / 255
    model = Derenderer.from_preset("small", seed=seed, image_size=SIZE, width=8, light_width=4, code_size=32)
    model.renderer = as_renderer(partial(render_scene, backend=way.backend), "lambert")
    if way.compiled:
        torch._dynamo.reset()
        torch._dynamo.config.recompile_limit = PROGRAMS  # pyright: ignore[reportAttributeAccessIssue]
        for net in model.nets.values():
            for part in {"encoder", "decoder"} & dict(net.named_children()).keys():
                setattr(net, part, torch.compile(getattr(net, part), backend=way.compiled))
    optimiser = torch.optim.Adam(model.parameters(), lr=3e-4)
    precision = partial(torch.autocast, "cpu", torch.bfloat16) if way.bf16 else nullcontext
    l1 = []
    for step in range(steps):
        rows = torch.randperm(PICTURES, generator=torch.Generator().manual_seed(step))[:BATCH]
        noise = random_stream(seed, "perturb", step)
        result = training_step(model, pictures[rows], OBJECTIVE, None, noise, precision)
        optimiser.zero_grad(set_to_none=True)
        result.total.backward()
        optimiser.step()
        l1.append(result.terms["l1"])
    return torch.stack(l1).double()


def last_tenth(l1: Tensor) -> float:
    return float(l1[-max(1, len(l1) // 10) :].mean())


def drift(found: Tensor, expected: Tensor) -> tuple[float, float, float]:
    """Relative differences of the L1: in the first step, the largest, of the mean of the last tenth."""
    apart, end = (found - expected).abs() / expected, last_tenth(expected)
    return float(apart[0]), float(apart.max()), abs(last_tenth(found) - end) / end


def compiler() -> str | None:
    """The C++ compiler that torch.compile would call."""
    return next(filter(None, map(shutil.which, (os.environ.get("CXX", ""), "g++", "clang++"))), None)


def run(given: argparse.Namespace) -> int:
    """The script."""
    expected = course(FLOAT32, given.steps)
    print(
        f"{given.steps} steps of {BATCH} images of {SIZE} x {SIZE}; L1 {expected[0]:.4f} at first, ", end=""
    )
    print(f"{last_tenth(expected):.4f} in the last tenth with {FLOAT32.name}")
    print("| way | L1 of the first step | largest of all | mean of the last tenth | within |")
    print("| --- | ---: | ---: | ---: | --- |", flush=True)
    failed = 0
    for way in (way for way in WAYS if given.only in way.name):
        if way.compiled == "inductor" and not compiler():
            print(f"| {way.name} | left out: no C++ compiler found | | | |", flush=True)
            continue
        first, largest, end = drift(course(way, given.steps), expected)
        within = first <= way.first and end <= way.end
        failed += not within
        cells = (f"{value:.1e}" for value in (first, largest, end))
        print(f"| {way.name} | {' | '.join(cells)} | {'yes' if within else 'NO'} |", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--only", default="", help="ways whose name holds this")
    sys.exit(run(parser.parse_args()))
