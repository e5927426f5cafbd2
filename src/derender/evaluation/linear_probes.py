"""Kinds of probe by name, with one signature: features and training rows in, probabilities out.

``linear`` is the paper's head, ``centred`` that head on features whose mean over the training rows is 0.
``logistic`` is a penalised regression, ``k-NN`` the ten nearest by cosine of centred features. ``majority``,
the share of each value among the training rows, knows no image.

The paper's head (Klinghoffer et al., ECCV 2022, Sec. 4.4) is one linear layer, sigmoid with binary
cross-entropy (here also softmax with cross-entropy for classes), Adam 2e-4, 100 epochs, threshold 0.5. The
batch size is not stated; 64 is that of the paper's other trainings. So few small steps leave the head near
its random start: it measures the features' scale as much as their content, and leans on their mean.

The objective of the penalised regression is scikit-learn's: C times the sum of the losses plus half the
squared weights, intercept free. All labels and folds of one penalty are solved together, on principal axes.
There the curvature has a diagonal bound (Boehning and Lindsay 1988), and accelerated steps scaled by it need
only two matrix products each.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from pydantic import Field
from scipy.special import expit, log_softmax, softmax
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from derender.evaluation.linear_task import Task
from derender.evaluation.memory import Memory
from derender.evaluation.neighbours import finite_rows, unit_rows
from derender.features import named
from derender.settings import Settings

PROBES = {  # all there are, and how tables call them
    "linear": "the paper's head, frozen features",
    "centred": "the paper's head, frozen features, centred",
    "logistic": "penalised logistic regression",
    "k-NN": "10 nearest neighbours",
}
HEADS = ("linear", "logistic", "k-NN")  # asked where none are named
# C for rows whose mean squared length is 1: standardised features divided by the root of their number
PENALTIES = (1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3)
FOLDS = 5
BLOCK_ROWS, MOST_STEPS = 1_024, 2_000


class HeadSettings(Settings):
    """How a head is trained."""

    learning_rate: float = Field(default=2e-4, gt=0)
    epochs: int = Field(default=100, ge=1)
    batch_size: int = Field(default=64, ge=1)


PAPER_HEAD = HeadSettings()


def probe(
    head: str, features: np.ndarray, task: Task, rows: np.ndarray, tested: np.ndarray, seeds: Sequence[int],
    *, settings: HeadSettings = PAPER_HEAD, memory: Memory | None = None,
) -> np.ndarray:  # fmt: skip
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

    def learned(own: np.ndarray, seed: int) -> np.ndarray:
        if head == "k-NN":
            return nearest_answers(features[own], targets[own], features[tested])
        weight, bias, _ = logistic_weights(features[own], targets[own], kind=kind, seed=seed)
        blocks = np.array_split(features[tested], len(tested) // BLOCK_ROWS + 1)
        logits = np.concatenate([np.asarray(block, np.float64) @ weight for block in blocks]) + bias
        return softmax(logits, axis=1) if kind == "classes" else expit(logits)

    def make() -> np.ndarray:
        if not papers:
            return np.stack(list(map(learned, rows, seeds))).astype(np.float32)
        asked = torch.from_numpy(np.ascontiguousarray(features[tested]))
        heads = zip(*fitted_heads(features, task, rows, seeds, settings, head == "centred"), strict=True)
        return np.stack([probabilities(torch.addmm(b, asked - m, w), kind).numpy() for m, w, b in heads])

    return (memory or Memory()).recall_one(f"probe-{head}", inputs, make)


def probe_runs(
    head: str, arrays: Sequence[np.ndarray], task: Task, rows: np.ndarray, tested: np.ndarray,
    seeds: Sequence[int], **how: Any,
) -> np.ndarray:  # fmt: skip
    """Answers of ``probe`` by several runs of one kind of feature: (S, T, A); ``how`` are its keywords.

    Seed s uses run s modulo their number, and seeds that share a run learn together.
    """
    answers = np.empty((len(seeds), len(tested), task.targets.shape[1]), np.float32)
    for run, array in enumerate(arrays[: len(seeds)]):
        mine = slice(run, None, len(arrays))
        answers[mine] = probe(head, array, task, rows[mine], tested, seeds[mine], **how)
    return answers


def nearest_answers(features: np.ndarray, targets: np.ndarray, tested: np.ndarray) -> np.ndarray:
    """Share of each value among the ten nearest training rows by cosine: (T, A), 0.5 if all are unknown."""
    mean = features.mean(axis=0)
    near, far = (unit_rows(np.asarray(rows, np.float64) - mean) for rows in (features, tested))
    result = np.argsort(-(far @ near.T), axis=1, kind="stable")[:, :10]
    return _shares(targets[result])


def majority_answers(task: Task, rows: np.ndarray, n_tested: int) -> np.ndarray:
    """The share of each value among the training rows, for everybody: (S, T, A)."""
    return np.repeat(_shares(task.targets[rows])[:, None].astype(np.float32), n_tested, axis=1)


def _shares(targets: np.ndarray) -> np.ndarray:
    """Share of 1 among the known of (B, n, A) targets: (B, A), 0.5 where none is known."""
    known = targets >= 0
    total = known.sum(axis=1)
    return np.divide((targets * known).sum(axis=1), total, out=np.full(total.shape, 0.5), where=total > 0)


def fitted_heads(
    features: np.ndarray, task: Task, rows: np.ndarray, seeds: Sequence[int], settings: HeadSettings,
    centred: bool,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Train one head for each seed at once: (S, 1, D) means, (S, D, A) weights, (S, 1, A) biases.

    Args:
        features, task: (N, D); (N, A) targets in -1 (unknown, no part in the loss), 0, 1, and their kind.
        rows: (S, n) training rows of each seed.
        seeds, settings: (S,) for the start and the order of rows; of the training.
        centred: take the mean of each seed's training rows from all features first; else the means are 0.
    """
    x = torch.from_numpy(np.ascontiguousarray(features, np.float32))
    y = torch.from_numpy(np.asarray(task.targets, np.float32))
    streams, chosen = [torch.Generator().manual_seed(seed) for seed in seeds], torch.from_numpy(rows)
    shapes = (x.shape[1], y.shape[1]), (1, y.shape[1])
    starts = (torch.stack([torch.rand(shape, generator=one) for one in streams]) for shape in shapes)
    # uniform in +-1/sqrt(inputs), as torch's linear layer starts
    weight, bias = (((start * 2 - 1) / x.shape[1] ** 0.5).requires_grad_() for start in starts)
    optimiser = torch.optim.Adam([weight, bias], lr=settings.learning_rate)
    means = torch.stack([x[own].mean(dim=0, keepdim=True) for own in chosen]) * centred
    for _ in range(settings.epochs):
        orders = [own[torch.randperm(len(own), generator=g)] for own, g in zip(chosen, streams, strict=True)]
        for batch in torch.stack(orders).split(settings.batch_size, dim=1):
            loss = head_loss(torch.baddbmm(bias, x[batch] - means, weight), y[batch], task.kind).sum()
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            optimiser.step()
    return means, weight.detach(), bias.detach()


def head_loss(logits: Tensor, targets: Tensor, kind: str) -> Tensor:
    """Mean loss of each of S heads on (S, B, A) logits: (S,), over known labels or rows of a known class.

    ``targets`` are -1 (unknown), 0, 1; for classes one-hot, or all -1. 0 where none is known.
    """
    known, truth = targets >= 0, targets.clamp(min=0)
    if kind == "classes":
        each = -(torch.log_softmax(logits, dim=-1) * truth).sum(dim=-1)
        known = known.any(dim=-1)
        return (each * known).sum(dim=1) / known.sum(dim=1).clamp(min=1)
    each = binary_cross_entropy_with_logits(logits, truth, weight=known.float(), reduction="none")
    return each.sum(dim=(1, 2)) / known.sum(dim=(1, 2)).clamp(min=1)


def probabilities(logits: Tensor, kind: str) -> Tensor:
    """Sigmoid of each label, or softmax over the classes."""
    return logits.softmax(dim=-1) if kind == "classes" else logits.sigmoid()


def rotated(features: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(n, D) rows standardised, scaled, rotated to their rank, (n, R); their mean; (D, R) the way back."""
    features = np.asarray(features, np.float64)
    mean, deviation = features.mean(axis=0), features.std(axis=0)
    scale = np.where(deviation > 1e-8 * max(deviation.max(), 1e-300), deviation, np.inf)
    scale *= max(np.isfinite(scale).sum(), 1) ** 0.5
    rows = (features - mean) / scale
    wide = rows.shape[0] < rows.shape[1]
    value, vector = np.linalg.eigh(rows @ rows.T if wide else rows.T @ rows)
    kept = value > max(value.max(), 0) * 1e-10
    rotation = rows.T @ (vector[:, kept] / np.sqrt(value[kept])) if wide else vector[:, kept]
    return rows @ rotation, mean, rotation / scale[:, None]


def logistic_weights(
    features: np.ndarray, targets: np.ndarray, *, kind: str, penalties: Sequence[float] = PENALTIES,
    folds: int = FOLDS, seed: int = 0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Choose C by cross-validation and fit on all rows: (D, A) weights, (A,) biases, and the chosen C.

    ``features`` are (n, D), ``targets`` (n, A) in -1 (unknown), 0, 1, one-hot for classes. Of kind "labels"
    each label has its C, (A,), of "classes" all have one, (1,).
    """
    if len(features) < folds or folds < 2:
        need = f"a penalty is chosen on {max(folds, 2)} labelled rows or more"
        fix = "give more, or choose the linear or the k-NN head"
        raise ValueError(f"{len(features)} rows cannot be cut into {folds} folds: {need}; {fix}")
    (rows, mean, back), labels = rotated(features), np.asarray(targets, np.float64)
    fold = np.random.default_rng(seed).permutation(len(rows)) % folds
    learned, single, losses = fold[:, None] != np.arange(folds), rows.astype(np.float32), []
    truth = np.maximum(labels, 0)[:, None]
    for c in penalties:
        weights = solve_logistic(single, labels, learned, c, kind, tolerance=1e-3)
        logits = np.tensordot(single, weights[:-1], axes=1) + weights[-1]  # (n, folds, A)
        if kind == "classes":
            loss = -(log_softmax(logits, axis=2) * truth).sum(axis=2, keepdims=True)
        else:
            loss = np.where(labels[:, None] >= 0, np.logaddexp(0, logits) - truth * logits, 0.0)
        losses.append(np.where(learned[:, :, None], 0.0, loss).sum(axis=(0, 1)))
    chosen = np.asarray(penalties)[np.argmin(losses, axis=0)]
    whole = np.ones((len(rows), 1), bool)
    result = {c: solve_logistic(rows, labels, whole, c, kind)[:, 0] for c in set(chosen.tolist())}
    own = np.broadcast_to(chosen, labels.shape[1])
    picked = np.stack([result[c][:, label] for label, c in enumerate(own.tolist())], axis=1)
    return back @ picked[:-1], picked[-1] - mean @ (back @ picked[:-1]), chosen


def solve_logistic(
    rows: np.ndarray, targets: np.ndarray, learned: np.ndarray, c: float, kind: str, tolerance: float = 1e-5
) -> np.ndarray:
    """Solve P regressions on parts of the same rows: (R + 1, P, A) weights, the intercept last.

    ``rows`` are (n, R), centred, with columns orthogonal to each other (from ``rotated``). ``learned``, (n,
    P) bool, are those that each regression learns from, ``c`` is their penalty. It stops when every scaled
    gradient is below ``tolerance`` of its start, or after ``MOST_STEPS``.
    """
    dtype = rows.dtype
    design = np.column_stack((rows, np.ones(len(rows), dtype)))
    truth = np.maximum(targets, 0).astype(dtype)[:, None]
    counted = (learned[:, :, None] & (targets >= 0)[:, None]).astype(dtype)
    ridge = np.append(np.ones(rows.shape[1]), 0.0)[:, None, None].astype(dtype)
    curve = 0.25 if kind == "labels" else 0.5
    power = (design.astype(np.float64) ** 2).sum(axis=0)[:, None, None]
    bound, strength = (curve * power * c + ridge).astype(dtype), dtype.type(c)
    weights = ahead = np.zeros((design.shape[1], learned.shape[1], targets.shape[1]), dtype)
    momentum, start = np.ones((1, learned.shape[1], 1), dtype), None
    for step in range(MOST_STEPS):
        logits = np.tensordot(design, ahead, axes=1)
        answer = expit(logits) if kind == "labels" else softmax(logits, axis=2)
        slope = np.tensordot(design.T, (answer - truth) * counted, axes=1) * strength + ridge * ahead
        moved = ahead - slope / bound
        change = moved - weights
        momentum[:, (slope * change).sum(axis=(0, 2)) > 0] = 1  # uphill: forgotten
        following = (1 + np.sqrt(1 + 4 * momentum**2)) / 2
        ahead = moved + (momentum - 1) / following * change
        weights, momentum = moved, following
        if step % 10 == 0:
            size = np.sqrt((slope.astype(np.float64) ** 2 / bound).sum(axis=0))
            start = np.maximum(size, 1e-12) if start is None else start
            if (size <= tolerance * start).all():
                break
    return weights
