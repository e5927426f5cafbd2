"""The two processes of test_distributed.py: commands, then a step on half a batch beside the whole one.

The step runs in float64, where rounding cannot hide a difference. The first process writes what it found.
"""

import json
import os
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import torch
from torch import distributed

from derender.cli import main as command
from derender.model import Derenderer
from derender.objectives.self_features import SelfFeatures
from derender.render import render_scene
from derender.training.config import ObjectiveSettings, resolve
from derender.training.distributed import ALONE, Ranks, leave, open_fabric
from derender.training.step import training_step

OBJECTIVE = ObjectiveSettings(loocc="all", cycle_weight=1.0, smoothness_weight=0.1)
SIZES = ["image_size=32", "width=4", "light_width=4"]


def step(model: Derenderer, images: torch.Tensor, own: float, ranks: Ranks):
    """Terms and gradients of one step, averaged over ranks as DDP does."""
    model.zero_grad(set_to_none=True)
    noise = torch.Generator().manual_seed(3)
    features = SelfFeatures((4, 8, 8)).double()
    torch.manual_seed(0)
    for parameter in features.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    how = {"own": own, "ranks": ranks, "chunks": 1 + (own < 1)}
    result = training_step(model, ranks.own(images), OBJECTIVE, features, noise, **how)
    result.total.backward()
    gradients = {name: p.grad for name, p in model.named_parameters() if p.grad is not None}
    if ranks.count > 1:
        for gradient in gradients.values():
            distributed.all_reduce(gradient)
            gradient /= ranks.count
    return ranks.mean({name: term.item() for name, term in result.terms.items()}), gradients


def largest_difference(own: float, ranks: Ranks) -> dict[str, float]:
    """Of terms and gradients, each relative to its size: whole batch against shared batch."""
    settings = resolve("small", SIZES).model
    renderer = partial(render_scene, backend="reference")
    model = Derenderer.seeded(settings, 0, renderer=renderer).double()
    images = torch.rand(4, 3, 32, 32, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    images[:2, :, :16] *= 0.5  # the two halves are no copies in the mean
    whole_terms, whole = step(model, images, own, ALONE) if ranks.first else ({}, {})
    terms, shared = step(model, images, own, ranks)
    if not ranks.first:
        return {}
    assert whole_terms.keys() == terms.keys()
    assert whole.keys() == shared.keys()
    of_terms = max(abs(terms[name] / value - 1) for name, value in whole_terms.items())
    apart = {name: (shared[name] - value).abs().max() for name, value in whole.items()}
    gradients = max(float(apart[name] / one.abs().max().clamp(min=1e-12)) for name, one in whole.items())
    return {"terms": of_terms, "gradients": gradients, "loocc": whole_terms["loocc"]}


def one_rank(environment: Mapping[str, str], commands: Sequence[list[str]], found: Path, port: str) -> int:
    """In a process forked for it: what is printed goes to the file descriptor 2, exit codes among it."""
    os.environ |= environment
    sys.stdout = sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115
    torch.set_num_threads(1)
    for words in commands:
        sys.stderr.write(f"\nended with {command(words)}\n")
        sys.stderr.flush()
    os.environ["MASTER_PORT"] = port  # the last command has left its group
    torch.Tensor.float = torch.Tensor.double
    fabric = open_fabric("cpu")
    ranks = Ranks(fabric.global_rank, fabric.world_size)
    result = {"count": ranks.count, "steps": [largest_difference(own, ranks) for own in (1.0, 0.3)]}
    if ranks.first:
        found.write_text(json.dumps(result))
    leave()
    return 0
