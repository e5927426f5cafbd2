"""Scores of a clustering against classes, and their chance level.

A score is one function below ``@metric``; its name goes to JSON and its column to tables. All come from the
table of counts (class by cluster), many tables at a time. Accuracy and F1 are the paper's (Sec. 4.2); NMI,
ARI and Hungarian accuracy are those of scikit-learn and SciPy. Purity and NMI of random clusters are far from
0: read no score without its chance level.
"""

from collections.abc import Callable, Iterable

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.special import xlogy

from derender.evaluation.score_table import Column
from derender.features import missing

SEEDS = tuple(range(10))

Metric = Callable[[np.ndarray], np.ndarray]
"""(B,) scores of (B, classes, clusters) numbers of rows; each of the B tables has at least one."""
METRICS: dict[str, Metric] = {}  # by name; every score is best at 1
CLUSTER_COLUMNS: dict[str, Column] = {}


def metric(name: str, shown: str, note: str) -> Callable[[Metric], Metric]:
    """Declare a score: its name in JSON, the head of its column, and its range and meaning."""

    def declare(function: Metric) -> Metric:
        METRICS[name], CLUSTER_COLUMNS[name] = function, Column(shown, "high", note=note)
        return function

    return declare


@metric("accuracy", "accuracy", "weighted purity, 0 to 1")
def purity(table: np.ndarray) -> np.ndarray:
    """The paper's accuracy: the share of rows that carry their cluster's majority label."""
    return table.max(axis=1).sum(axis=1) / table.sum(axis=(1, 2))


@metric("f1", "F1", "weighted F1 of majority labels, 0 to 1")
def majority_f1(table: np.ndarray) -> np.ndarray:
    """Weighted F1 of clusters that answer their majority label."""
    by_class = table.sum(axis=2)
    answers = table.argmax(axis=1)[:, None] == np.arange(table.shape[1])[:, None]  # (B, classes, clusters)
    answered = (answers * table.sum(axis=1)[:, None]).sum(axis=2)
    right = (answers * table).sum(axis=2)
    f1 = np.divide(2 * right, answered + by_class, out=np.zeros_like(right), where=answered + by_class > 0)
    return (by_class * f1).sum(axis=1) / by_class.sum(axis=1)


@metric("nmi", "NMI", "normalised mutual information, 0 to 1")
def mutual_information(table: np.ndarray) -> np.ndarray:
    """Mutual information over the mean entropy; 1 where both sides are one group, as in scikit-learn."""
    total, sides = table.sum(axis=(1, 2)), (table.sum(axis=2), table.sum(axis=1))
    classes, clusters = (np.log(total) - xlogy(side, side).sum(axis=1) / total for side in sides)
    joint = np.log(total) - xlogy(table, table).sum(axis=(1, 2)) / total
    mean = (classes + clusters) / 2
    single = np.all([(side > 0).sum(axis=1) == 1 for side in sides], axis=0)
    information = np.maximum(classes + clusters - joint, 0)
    values = np.divide(information, mean, out=np.zeros_like(mean), where=~single & (mean > 0))
    return np.where(single, 1.0, values)


@metric("hungarian", "matched", "share of rows under the best one-to-one matching, 0 to 1")
def matched(table: np.ndarray) -> np.ndarray:
    """The share of rows under the best one-to-one matching of clusters to classes."""
    if table.shape[1:] == (2, 2):
        straight, crossed = table[:, 0, 0] + table[:, 1, 1], table[:, 0, 1] + table[:, 1, 0]
        return np.maximum(straight, crossed) / table.sum(axis=(1, 2))
    best = [one[linear_sum_assignment(one, maximize=True)].sum() for one in table]
    return np.array(best) / table.sum(axis=(1, 2))


@metric("ari", "ARI", "adjusted Rand index, 0 for random clusters, at most 1")
def adjusted_rand(table: np.ndarray) -> np.ndarray:
    """Pairs that lie together on both sides, beyond chance, -0.5 to 1; 1 where there is no doubt."""

    def pairs(values: np.ndarray) -> np.ndarray:
        return values * (values - 1) / 2

    together = pairs(table).sum(axis=(1, 2))
    in_class, in_cluster = (pairs(table.sum(axis=axis)).sum(axis=1) for axis in (2, 1))
    expected = in_class * in_cluster / np.maximum(pairs(table.sum(axis=(1, 2))), 1)
    most = (in_class + in_cluster) / 2
    same = (together == in_class) & (together == in_cluster)
    return np.divide(together - expected, most - expected, out=np.ones_like(most), where=~same)


def scores_of_counts(counts: np.ndarray) -> np.ndarray:
    """Every score of ``METRICS`` of (B, classes, clusters) counts: (B, scores)."""
    return np.column_stack([score(np.asarray(counts, np.float64)) for score in METRICS.values()])


def cluster_scores(labels: np.ndarray, assignment: np.ndarray) -> dict[str, float]:
    """Score any (N,) clustering of rows against their (N,) classes; names do not matter."""
    classes, assignment = encoded(labels), np.asarray(assignment)
    if (classes < 0).any():
        raise ValueError(f"{(classes < 0).sum()} labels are missing: drop these rows first")
    if assignment.shape != classes.shape:
        raise ValueError(f"labels {classes.shape} and assignment {assignment.shape} must be of one length")
    if len(classes) == 0:
        raise ValueError("nothing to score: no rows")
    clusters = np.unique(assignment, return_inverse=True)[1]
    counts = np.zeros((1, classes.max() + 1, clusters.max() + 1))
    np.add.at(counts[0], (classes, clusters), 1)
    return dict(zip(METRICS, scores_of_counts(counts)[0].tolist(), strict=True))


def chance_scores(
    labels: np.ndarray, clusters: np.ndarray | int, seeds: Iterable[int] = SEEDS
) -> dict[str, float]:
    """Mean scores when rows are dealt to clusters at random, once for each seed.

    ``clusters`` is an assignment whose cluster sizes are kept, or a number of clusters of equal size.
    """
    sizes = np.arange(len(labels)) % clusters if isinstance(clusters, int) else np.asarray(clusters)
    deals = [cluster_scores(labels, np.random.default_rng(seed).permutation(sizes)) for seed in seeds]
    if not deals:
        raise ValueError("the chance level needs at least one seed")
    return {name: float(np.mean([deal[name] for deal in deals])) for name in METRICS}


def encoded(labels: np.ndarray) -> np.ndarray:
    """Classes as integers from 0, -1 where missing."""
    labels = np.asarray(labels)
    if labels.ndim != 1:
        raise ValueError(f"labels must be one value per row, got shape {labels.shape}")
    known = ~missing(labels)
    values, classes = labels[known], np.full(len(labels), -1, np.int64)
    if values.dtype.kind == "O":
        numbers = {value: number for number, value in enumerate(dict.fromkeys(values.tolist()))}
        classes[known] = [numbers[value] for value in values.tolist()]
    else:
        classes[known] = np.unique(values, return_inverse=True)[1]
    return classes
