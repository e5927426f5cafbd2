"""Scores of a clustering against classes, and what chance would give.

All come from the table of counts (class by cluster), many tables at a time, so that a thousand resamples
cost little more than one. Accuracy and F1 are the paper's (Sec. 4.2); NMI, ARI and Hungarian accuracy as in
scikit-learn and SciPy, which the tests compare with. Purity and NMI of random clusters are far from 0, and
purity of one cluster is the majority's share: read no score without its chance.
"""

from collections.abc import Iterable
from dataclasses import astuple, dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.special import xlogy

from derender.features import missing

SEEDS = tuple(range(10))


@dataclass(frozen=True)
class ClusterScores:
    """How well clusters agree with classes. Every score is best at 1.

    Attributes:
        accuracy: weighted purity, the paper's accuracy: share of rows that carry their cluster's majority
            label; 0..1.
        f1: weighted F1 of the majority labels; 0..1.
        nmi: mutual information over the arithmetic mean of the entropies; 0..1.
        hungarian: share of rows under the best one-to-one matching of clusters to classes; 0..1.
        ari: adjusted Rand index; -0.5..1, 0 for random clusters.
    """

    accuracy: float
    f1: float
    nmi: float
    hungarian: float
    ari: float


def cluster_scores(labels: np.ndarray, assignment: np.ndarray) -> ClusterScores:
    """Score any clustering of labelled rows; names of clusters and classes do not matter.

    Args:
        labels: (N,) classes, none missing.
        assignment: (N,) cluster of each row.
    """
    classes, assignment = encoded(labels), np.asarray(assignment)
    if assignment.shape != classes.shape:
        raise ValueError(f"labels {classes.shape} and assignment {assignment.shape} must be of one length")
    if len(classes) == 0:
        raise ValueError("nothing to score: no rows")
    clusters = np.unique(assignment, return_inverse=True)[1]
    counts = np.zeros((classes.max() + 1, clusters.max() + 1))
    np.add.at(counts, (classes, clusters), 1)
    return ClusterScores(*scores_of_counts(counts[None])[0].tolist())


def scores_of_counts(counts: np.ndarray) -> np.ndarray:
    """The five scores of many clusterings at once, in the order of ``ClusterScores``: (B, 5).

    Args:
        counts: (B, classes, clusters) numbers of rows, each table with at least one row.
    """
    counts = np.asarray(counts, np.float64)
    total = counts.sum(axis=(1, 2))
    by_class, by_cluster = counts.sum(axis=2), counts.sum(axis=1)
    return np.column_stack(
        (
            counts.max(axis=1).sum(axis=1) / total,
            _majority_f1(counts, by_class, by_cluster),
            _nmi(counts, by_class, by_cluster, total),
            _matched(counts) / total,
            _ari(counts, by_class, by_cluster, total),
        )
    )


def chance_scores(
    labels: np.ndarray, clusters: np.ndarray | int, seeds: Iterable[int] = SEEDS
) -> tuple[ClusterScores, ClusterScores]:
    """Mean and standard deviation of the scores when rows are dealt at random.

    Args:
        labels: (N,) classes.
        clusters: an assignment whose cluster sizes are kept, or a number of clusters of equal size.
        seeds: one random deal each.
    """
    n_rows = len(labels)
    sizes = np.arange(n_rows) % clusters if isinstance(clusters, (int, np.integer)) else np.asarray(clusters)
    deals = [cluster_scores(labels, np.random.default_rng(seed).permutation(sizes)) for seed in seeds]
    if not deals:
        raise ValueError("the chance level needs at least one seed")
    values = np.array([astuple(deal) for deal in deals])
    return ClusterScores(*values.mean(axis=0).tolist()), ClusterScores(*values.std(axis=0).tolist())


def encoded(labels: np.ndarray) -> np.ndarray:
    """Classes as integers from 0."""
    labels = np.asarray(labels)
    if labels.ndim != 1:
        raise ValueError(f"labels must be one value per row, got shape {labels.shape}")
    if missing(labels).any():
        raise ValueError(f"{int(missing(labels).sum())} labels are missing: drop these rows first")
    if labels.dtype.kind == "O":
        numbers = {value: number for number, value in enumerate(dict.fromkeys(labels.tolist()))}
        return np.array([numbers[value] for value in labels.tolist()], dtype=np.int64)
    return np.unique(labels, return_inverse=True)[1]


def _majority_f1(counts: np.ndarray, by_class: np.ndarray, by_cluster: np.ndarray) -> np.ndarray:
    """Weighted F1 of clusters that answer their majority label."""
    answers = counts.argmax(axis=1)[:, None] == np.arange(counts.shape[1])[:, None]  # (B, classes, clusters)
    answered = (answers * by_cluster[:, None]).sum(axis=2)
    right = (answers * counts).sum(axis=2)
    f1 = np.divide(2 * right, answered + by_class, out=np.zeros_like(right), where=answered + by_class > 0)
    return (by_class * f1).sum(axis=1) / by_class.sum(axis=1)


def _nmi(counts: np.ndarray, by_class: np.ndarray, by_cluster: np.ndarray, total: np.ndarray) -> np.ndarray:
    """Mutual information over the mean entropy; 1 where both sides are one group, as in scikit-learn."""
    class_entropy = np.log(total) - xlogy(by_class, by_class).sum(axis=1) / total
    cluster_entropy = np.log(total) - xlogy(by_cluster, by_cluster).sum(axis=1) / total
    joint_entropy = np.log(total) - xlogy(counts, counts).sum(axis=(1, 2)) / total
    information = np.maximum(class_entropy + cluster_entropy - joint_entropy, 0)
    mean = (class_entropy + cluster_entropy) / 2
    single = ((by_class > 0).sum(axis=1) == 1) & ((by_cluster > 0).sum(axis=1) == 1)
    values = np.divide(information, mean, out=np.zeros_like(mean), where=~single & (mean > 0))
    return np.where(single, 1.0, values)


def _matched(counts: np.ndarray) -> np.ndarray:
    """Rows under the best one-to-one matching of clusters to classes."""
    if counts.shape[1:] == (2, 2):
        straight, crossed = counts[:, 0, 0] + counts[:, 1, 1], counts[:, 0, 1] + counts[:, 1, 0]
        return np.maximum(straight, crossed)
    return np.array([table[linear_sum_assignment(table, maximize=True)].sum() for table in counts])


def _ari(counts: np.ndarray, by_class: np.ndarray, by_cluster: np.ndarray, total: np.ndarray) -> np.ndarray:
    """Pairs that lie together on both sides, beyond what chance would give; 1 where there is no doubt."""

    def pairs(values: np.ndarray) -> np.ndarray:
        return values * (values - 1) / 2

    together = pairs(counts).sum(axis=(1, 2))
    in_class, in_cluster = pairs(by_class).sum(axis=1), pairs(by_cluster).sum(axis=1)
    all_pairs = np.maximum(pairs(total), 1)
    expected = in_class * in_cluster / all_pairs
    most = (in_class + in_cluster) / 2
    same = (together == in_class) & (together == in_cluster)
    values = np.divide(together - expected, most - expected, out=np.ones_like(most), where=~same)
    return np.where(same, 1.0, values)
