"""Logistic regression with a penalty chosen by cross-validation, for many labels at once.

The objective is scikit-learn's: C times the sum of the losses plus half the squared weights, intercept
free; tests hold both to the same answer. Forty labels, six penalties and five folds are 1,200 regressions
on one set of rows, so all are solved together: the rows are rotated onto their principal axes (which
changes nothing under this penalty, and makes 12,288 pixels of 1,000 rows 1,000 numbers), there the
curvature has a diagonal bound (Boehning and Lindsay 1988), and accelerated steps scaled by it need only two
matrix products each. A regression that is solved leaves the others to go on.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import expit, log_softmax, softmax

PENALTIES = (1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3)
"""C for rows whose mean squared length is 1: standardised features divided by the root of their number."""
FOLDS = 5
BLOCK_ROWS = 1_024


@dataclass(frozen=True)
class Axes:
    """How features become what is regressed on: standardised, scaled, rotated."""

    mean: np.ndarray
    scale: np.ndarray
    rotation: np.ndarray

    def apply(self, features: np.ndarray) -> np.ndarray:
        """(N, D) features as (N, R)."""
        found = np.empty((len(features), self.rotation.shape[1]))
        for start in range(0, len(features), BLOCK_ROWS):
            block = np.asarray(features[start : start + BLOCK_ROWS], np.float64)
            found[start : start + BLOCK_ROWS] = ((block - self.mean) / self.scale) @ self.rotation
        return found


def axes_of(features: np.ndarray) -> Axes:
    """Fit to (n, D) training rows; R is their rank."""
    features = np.asarray(features, np.float64)
    mean, deviation = features.mean(axis=0), features.std(axis=0)
    scale = np.where(deviation > 1e-8 * max(deviation.max(), 1e-300), deviation, np.inf)
    scale *= max(np.isfinite(scale).sum(), 1) ** 0.5
    rows = (features - mean) / scale
    wide = rows.shape[0] < rows.shape[1]
    value, vector = np.linalg.eigh(rows @ rows.T if wide else rows.T @ rows)
    kept = value > max(value.max(), 0) * 1e-10
    vector = vector[:, kept]
    return Axes(mean, scale, rows.T @ (vector / np.sqrt(value[kept])) if wide else vector)


def fit_logistic(
    features: np.ndarray,
    targets: np.ndarray,
    tested: np.ndarray,
    *,
    kind: str,
    penalties: Sequence[float] = PENALTIES,
    folds: int = FOLDS,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Choose C on the training rows alone, fit on all of them, answer for (T, D) others.

    ``features`` are (n, D), ``targets`` (n, A) in -1 (unknown), 0, 1, one-hot for classes. Of kind "labels"
    each label has its C, of "classes" all have one. Returns (T, A) probabilities, and the chosen C: (A,) or
    (1,).
    """
    if len(features) < folds or folds < 2:
        raise ValueError(
            f"{len(features)} rows cannot be cut into {folds} folds: a penalty is chosen on {max(folds, 2)} "
            "labelled rows or more; give more, or choose the linear or the k-NN head"
        )
    axes = axes_of(features)
    rows, labels = axes.apply(features), np.asarray(targets, np.float64)
    fold = np.random.default_rng(seed).permutation(len(rows)) % folds
    learned = np.repeat([fold != number for number in range(folds)], len(penalties), axis=0).T
    single, c = rows.astype(np.float32), np.tile(np.asarray(penalties, np.float64), folds)
    weights = solve_logistic(single, labels, learned, c, kind, tolerance=1e-3)
    loss = _losses(_logits(single, weights), labels, kind)  # (n, problems, A or 1)
    loss = np.where(learned[:, :, None], 0.0, loss).reshape(len(rows), folds, len(penalties), -1)
    chosen = np.asarray(penalties)[loss.sum(axis=(0, 1)).argmin(axis=0)]  # (A,) or (1,)
    distinct, own = np.unique(chosen, return_inverse=True)
    every = np.ones((len(rows), len(distinct)), bool)
    answer = _logits(axes.apply(tested), solve_logistic(rows, labels, every, distinct, kind))
    if kind == "classes":
        return softmax(answer[:, own[0]], axis=1), chosen
    return expit(answer[:, own, np.arange(labels.shape[1])]), chosen


def solve_logistic(
    rows: np.ndarray,
    targets: np.ndarray,
    learned: np.ndarray,
    c: np.ndarray,
    kind: str,
    *,
    tolerance: float = 1e-5,
    most_steps: int = 2_000,
) -> np.ndarray:
    """Solve P regressions on parts of the same rows: (R + 1, P, A) weights, the intercept last.

    ``rows`` are (n, R), centred, with columns orthogonal to each other (from ``axes_of``); ``learned``, (n,
    P) bool, are those that each regression learns from, ``c`` (P,) penalties. It stops when the scaled
    gradient is below ``tolerance`` of its start, or after ``most_steps``.
    """
    dtype = rows.dtype
    design = np.column_stack((rows, np.ones(len(rows), dtype)))
    truth = np.maximum(targets, 0).astype(dtype)[:, None]
    counted = (learned[:, :, None] & (targets >= 0)[:, None]).astype(dtype)
    ridge = np.append(np.ones(rows.shape[1]), 0.0)[:, None, None].astype(dtype)
    curve = 0.25 if kind == "labels" else 0.5
    bound = curve * (design.astype(np.float64) ** 2).sum(axis=0)[:, None, None] * c[None, :, None] + ridge
    bound, strength = bound.astype(dtype), c[None, :, None].astype(dtype)

    found = np.zeros((design.shape[1], len(c), targets.shape[1]), dtype)
    weights = ahead = found.copy()
    momentum, start, left = np.ones((1, len(c), 1), dtype), None, np.arange(len(c))
    for step in range(most_steps):
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
            rest = ~(size <= tolerance * start).all(axis=1)
            if not rest.all():
                found[:, left[~rest]] = moved[:, ~rest]
                left, start = left[rest], start[rest]
                momentum, weights, ahead, counted, bound, strength = (
                    one[:, rest] for one in (momentum, weights, ahead, counted, bound, strength)
                )
            if not len(left):
                return found
    found[:, left] = weights
    return found


def _logits(rows: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(N, P, A) logits of (N, R) rows."""
    return np.tensordot(rows, weights[:-1], axes=1) + weights[-1]


def _losses(logits: np.ndarray, targets: np.ndarray, kind: str) -> np.ndarray:
    """Negative log-likelihood of each row: (N, P, A), or (N, P, 1) for classes; 0 where unknown."""
    truth = targets[:, None]
    if kind == "classes":
        return -(log_softmax(logits, axis=2) * np.maximum(truth, 0)).sum(axis=2, keepdims=True)
    return np.where(truth >= 0, np.logaddexp(0, logits) - truth * logits, 0.0)
