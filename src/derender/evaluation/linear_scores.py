"""Accuracy, balanced accuracy and average precision of probabilities, on rows and on their resamples.

All are averaged over labels (or classes). Accuracy rewards the majority's answer (0.80 on CelebA): balanced
accuracy is 0.5 for any constant answer (one over the number of classes), and average precision, which needs
no threshold, is the label's share for answers that know nothing.
"""

from dataclasses import dataclass

import numpy as np
from sklearn.metrics import average_precision_score

SCORES = ("accuracy", "balanced_accuracy", "average_precision")


@dataclass(frozen=True)
class LinearScores:
    """How right answers are; all 0..1, best 1.

    Attributes:
        accuracy: share of right answers, at threshold 0.5 for each label, or of the likeliest class.
        balanced_accuracy: mean of the shares of right answers among the rows of each value or class.
        average_precision: area under precision over recall, of the value 1 or of each class against the rest.
    """

    accuracy: float
    balanced_accuracy: float
    average_precision: float


def linear_scores(targets: np.ndarray, probabilities: np.ndarray, kind: str) -> LinearScores:
    """Score (T, A) probabilities against (T, A) targets in -1 (unknown), 0, 1; one-hot for classes.

    Values and classes that no row has do not count.
    """
    accuracy, balanced = count_scores(targets, probabilities, kind, np.ones((1, len(targets)), np.float32))[0]
    precisions = []
    for truth, answer in zip(targets.T, probabilities.T, strict=True):
        rows = truth >= 0
        if (truth == 1).any():
            precisions.append(average_precision_score(truth[rows], answer[rows]))
    precision = float(np.mean(precisions)) if precisions else float("nan")
    return LinearScores(float(accuracy), float(balanced), precision)


def count_scores(
    targets: np.ndarray, probabilities: np.ndarray, kind: str, weights: np.ndarray
) -> np.ndarray:
    """Accuracy and balanced accuracy on resamples: (B, 2).

    Args:
        targets, probabilities: (T, A), see ``linear_scores``.
        kind: "labels" or "classes".
        weights: (B, T) how often each row is drawn.
    """
    if targets.shape != probabilities.shape:
        raise ValueError(f"targets {targets.shape} and probabilities {probabilities.shape} must be alike")
    positive, negative = (targets == 1).astype(np.float32), (targets == 0).astype(np.float32)
    if kind == "classes":
        right = probabilities.argmax(axis=1) == targets.argmax(axis=1)
        hits, sizes = weights @ (positive * right[:, None]), weights @ positive
        return np.column_stack((hits.sum(axis=1) / sizes.sum(axis=1), _mean(hits, sizes)))
    answered = probabilities > 0.5
    yes, no = weights @ (positive * answered), weights @ (negative * ~answered)
    positives, negatives = weights @ positive, weights @ negative
    recalls = np.stack((_share(yes, positives), _share(no, negatives)))
    balanced = np.nanmean(recalls, axis=0).mean(axis=1)
    return np.column_stack((_mean(yes + no, positives + negatives), balanced))


def _share(hits: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    return np.divide(hits, sizes, out=np.full_like(hits, np.nan), where=sizes > 0)


def _mean(hits: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Mean share over those labels or classes that have rows."""
    return np.nanmean(_share(hits, sizes), axis=1)
