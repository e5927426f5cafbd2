"""Kinds of probe by name, with one signature: features and training rows in, probabilities out.

``linear`` is the paper's head, ``centred`` the same on features whose mean over the training rows is 0,
``logistic`` a penalised regression, ``k-NN`` the ten nearest by cosine of centred features, ``majority`` the
share of each value among the training rows, which knows no image.

The paper's head (Klinghoffer et al., ECCV 2022, Sec. 4.4) is one linear layer, sigmoid with binary
cross-entropy (here also softmax with cross-entropy for classes), Adam 2e-4, 100 epochs, threshold 0.5.
Features enter as they are. The batch size is not stated; 64 is that of the paper's other trainings. With so
small a rate and so few steps the head stays near its random start: it measures the features' scale as much as
their content, which is why the penalised regression (linear_logistic.py) stands beside it. The bias moves by
0.3 at most in 1,600 steps, so on features of mean 0 every answer begins near one half, while others can lean
on their mean to answer with the majority; ``centred`` makes it the same for all.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from derender.evaluation.linear_logistic import fit_logistic
from derender.evaluation.linear_task import Task
from derender.evaluation.memory import Memory
from derender.evaluation.neighbours import finite_rows, unit_rows
from derender.features import named
from derender.settings import Settings

PROBES = {
    "linear": "the paper's head, frozen features",
    "centred": "the paper's head, frozen features, centred",
    "logistic": "penalised logistic regression",
    "k-NN": "10 nearest neighbours",
}
"""All there are, and how tables call them."""

HEADS = ("linear", "logistic", "k-NN")
"""Asked where none are named."""

NEIGHBOURS = 10


class HeadSettings(Settings):
    """How a head is trained."""

    learning_rate: float = Field(default=2e-4, gt=0)
    epochs: int = Field(default=100, ge=1)
    batch_size: int = Field(default=64, ge=1)


PAPER_HEAD = HeadSettings()


def probe(
    head: str,
    features: np.ndarray,
    task: Task,
    rows: np.ndarray,
    tested: np.ndarray,
    seeds: Sequence[int],
    *,
    settings: HeadSettings = PAPER_HEAD,
    memory: Memory | None = None,
) -> np.ndarray:
    """Learn from some rows and answer for others, once for each seed: (S, T, A) float32 probabilities.

    ``features`` are (N, D), ``rows`` (S, n) training rows, the (T,) ``tested`` rows take no part in any
    choice. The (S,) seeds are of starts and folds, ``settings`` of the paper's head, ``memory`` caches the
    answers.
    """
    named(PROBES, head, "head")
    features = finite_rows(features, "a linear probe").astype(np.float32)
    targets, kind, papers = task.targets, task.kind, head in ("linear", "centred")
    inputs = {
        "features": features, "targets": targets, "kind": kind, "rows": rows, "tested": tested,
        "seeds": list(seeds), "settings": settings.model_dump() if papers else {},
    }  # fmt: skip

    def answers(own: np.ndarray, seed: int) -> np.ndarray:
        if head == "k-NN":
            return nearest_answers(features[own], targets[own], features[tested])
        return fit_logistic(features[own], targets[own], features[tested], kind=kind, seed=seed)[0]

    def make() -> np.ndarray:
        if papers:
            how = {"kind": kind, "seeds": seeds, "settings": settings, "centred": head == "centred"}
            return train_heads(features, targets, rows, tested, **how).astype(np.float32)
        return np.stack([answers(*one) for one in zip(rows, seeds, strict=True)]).astype(np.float32)

    return (memory or Memory()).recall_one(f"probe-{head}", inputs, make)


def probe_runs(
    head: str,
    arrays: Sequence[np.ndarray],
    task: Task,
    rows: np.ndarray,
    tested: np.ndarray,
    seeds: Sequence[int],
    settings: HeadSettings,
    memory: Memory | None,
) -> np.ndarray:
    """(S, T, A) answers; seed s uses run s modulo their number, and seeds that share a run learn together."""
    answers = {}
    for run, array in enumerate(arrays[: len(seeds)]):
        mine = list(range(run, len(seeds), len(arrays)))
        own = [seeds[at] for at in mine]
        found = probe(head, array, task, rows[mine], tested, own, settings=settings, memory=memory)
        answers |= dict(zip(mine, found, strict=True))
    return np.stack([answers[at] for at in range(len(seeds))])


def nearest_answers(
    features: np.ndarray, targets: np.ndarray, tested: np.ndarray, neighbours: int = NEIGHBOURS
) -> np.ndarray:
    """Share of each value among the nearest training rows by cosine: (T, A), 0.5 where all are unknown."""
    mean = features.mean(axis=0)
    near, far = (unit_rows(np.asarray(rows, np.float64) - mean) for rows in (features, tested))
    found = np.argsort(-(far @ near.T), axis=1, kind="stable")[:, : min(neighbours, len(near))]
    return _shares(targets[found])


def majority_answers(task: Task, rows: np.ndarray, n_tested: int) -> np.ndarray:
    """The share of each value among the training rows, for everybody: (S, T, A)."""
    return np.repeat(_shares(task.targets[rows])[:, None].astype(np.float32), n_tested, axis=1)


def _shares(targets: np.ndarray) -> np.ndarray:
    """Share of 1 among the known of (B, n, A) targets: (B, A), 0.5 where none is known."""
    known = targets >= 0
    total = known.sum(axis=1)
    return np.divide((targets * known).sum(axis=1), total, out=np.full(total.shape, 0.5), where=total > 0)


def train_heads(
    features: np.ndarray,
    targets: np.ndarray,
    rows: np.ndarray,
    tested: np.ndarray,
    *,
    kind: str,
    seeds: Sequence[int],
    settings: HeadSettings = PAPER_HEAD,
    centred: bool = False,
) -> np.ndarray:
    """Answers of ``fitted_heads`` for the (T,) rows ``tested``: (S, T, A) probabilities."""
    how: dict[str, Any] = {"kind": kind, "seeds": seeds, "settings": settings, "centred": centred}
    asked = torch.from_numpy(np.ascontiguousarray(features[tested], np.float32))
    heads = zip(*fitted_heads(features, targets, rows, **how), strict=True)
    return np.stack([probabilities(torch.addmm(b, asked - m, w), kind).numpy() for m, w, b in heads])


def fitted_heads(
    features: np.ndarray,
    targets: np.ndarray,
    rows: np.ndarray,
    *,
    kind: str,
    seeds: Sequence[int],
    settings: HeadSettings = PAPER_HEAD,
    centred: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:
    """Train one head for each seed at once: (S, 1, D) means, (S, D, A) weights, (S, 1, A) biases.

    Args:
        features, targets: (N, D); (N, A) in -1 (unknown, no part in the loss), 0, 1.
        rows: (S, n) training rows of each seed.
        kind, settings: "labels" or "classes"; of the training.
        seeds: (S,) for the start and the order of rows.
        centred: take the mean of each seed's training rows from all features first; else the means are 0.
    """
    x = torch.from_numpy(np.ascontiguousarray(features, np.float32))
    y = torch.from_numpy(np.asarray(targets, np.float32))
    generators, chosen = [torch.Generator().manual_seed(seed) for seed in seeds], torch.from_numpy(rows)
    weight, bias = (  # uniform in +-1/sqrt(inputs), as torch's linear layer starts
        torch.stack(
            [(torch.rand(shape, generator=one) * 2 - 1) / x.shape[1] ** 0.5 for one in generators]
        ).requires_grad_()
        for shape in ((x.shape[1], y.shape[1]), (1, y.shape[1]))
    )
    optimiser = torch.optim.Adam([weight, bias], lr=settings.learning_rate)
    means = x.new_zeros(len(rows), 1, x.shape[1])
    if centred:
        means = torch.stack([x[own].mean(dim=0, keepdim=True) for own in chosen])
    for _ in range(settings.epochs):
        orders = [
            own[torch.randperm(len(own), generator=g)] for own, g in zip(chosen, generators, strict=True)
        ]
        for batch in torch.stack(orders).split(settings.batch_size, dim=1):
            loss = head_loss(torch.baddbmm(bias, x[batch] - means, weight), y[batch], kind).sum()
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            optimiser.step()
    return means, weight.detach(), bias.detach()


def head_loss(logits: Tensor, targets: Tensor, kind: str) -> Tensor:
    """Mean loss of each of S heads on (S, B, A) logits: (S,)."""
    if kind == "classes":
        return -(torch.log_softmax(logits, dim=-1) * targets).sum(dim=-1).mean(dim=1)
    known = (targets >= 0).float()
    each = torch.nn.functional.binary_cross_entropy_with_logits(
        logits, targets.clamp(min=0), weight=known, reduction="none"
    )
    return each.sum(dim=(1, 2)) / known.sum(dim=(1, 2)).clamp(min=1)


def probabilities(logits: Tensor, kind: str) -> Tensor:
    """Sigmoid of each label, or softmax over the classes."""
    return logits.softmax(dim=-1) if kind == "classes" else logits.sigmoid()
