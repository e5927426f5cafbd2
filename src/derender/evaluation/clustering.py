"""Clustering protocol: do features group pictures by a label that training never saw?

Source: Klinghoffer et al., ECCV 2022, Sec. 4: Ward's hierarchical clustering with as many clusters as
classes; accuracy is weighted purity; F1 is weighted F1 after each cluster took its majority label. Beside
these stand NMI, Hungarian accuracy and ARI, and for every score its chance level: the same clusters' sizes
with rows dealt at random. Leaves out other methods, many labels and intervals (clustering_compare.py).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from derender.evaluation.clustering_methods import clusterings
from derender.evaluation.clustering_scores import (
    SEEDS,
    ClusterScores,
    chance_scores,
    cluster_scores,
    encoded,
)
from derender.features import FeatureTable, missing


@dataclass(frozen=True)
class ClusteringResult:
    """One row of a table.

    Attributes:
        scores: of the clusters found.
        chance: mean over seeds of the scores of random clusters of the same sizes.
        chance_spread: their standard deviation over seeds.
        majority: share of the most frequent label, what always answering it would reach; 0..1.
        n_rows, n_classes, n_clusters: sizes of the problem after dropping.
        n_dropped: rows whose label is missing.
    """

    scores: ClusterScores
    chance: ClusterScores
    chance_spread: ClusterScores
    majority: float
    n_rows: int
    n_classes: int
    n_clusters: int
    n_dropped: int


def ward(features: np.ndarray, n_clusters: int) -> np.ndarray:
    """Ward clustering of (N, D) features into ``n_clusters``: (N,) integers."""
    return clusterings(features, (n_clusters,), "ward")[n_clusters]


def evaluate_clustering(
    features: np.ndarray, labels: np.ndarray, n_clusters: int | None = None, seeds: Iterable[int] = SEEDS
) -> ClusteringResult:
    """The whole protocol on arrays: drop rows without label, cluster, score, and say what chance would give.

    Args:
        features: (N, D).
        labels: (N,); None, NaN and "" are missing: dropped and counted.
        n_clusters: by default as many as there are classes.
        seeds: for the chance level.
    """
    features, labels = np.asarray(features), np.asarray(labels)
    if len(features) != len(labels):
        raise ValueError(f"{len(features)} rows of features but {len(labels)} labels: give one label per row")
    keep = ~missing(labels)
    features, labels = features[keep], labels[keep]
    counts = np.bincount(encoded(labels)) if len(labels) else np.zeros(0, dtype=np.int64)
    if len(counts) < 2:
        raise ValueError(
            f"clustering needs at least two classes, the {len(labels)} labelled rows have {len(counts)}: "
            "choose another label column"
        )
    wanted = len(counts) if n_clusters is None else n_clusters
    assignment = ward(features, wanted)
    chance, spread = chance_scores(labels, assignment, seeds)
    return ClusteringResult(
        cluster_scores(labels, assignment),
        chance,
        spread,
        majority=float(counts.max() / len(labels)),
        n_rows=len(labels),
        n_classes=len(counts),
        n_clusters=wanted,
        n_dropped=int((~keep).sum()),
    )


def at_least(labels: np.ndarray, count: int, most: int | None = None) -> np.ndarray:
    """Indices of the rows whose class has at least ``count`` members; of each class at most the first
    ``most``.

    LFW's protocol here is ``at_least(identity, 20, most=20)``: of its 31 people with 20 pictures one has
    530, and with all of them that one person decides the purity (0.35 for any clustering at all).
    """
    labels = np.asarray(labels)
    present = np.flatnonzero(~missing(labels))
    classes = encoded(labels[present])
    sizes = np.bincount(classes) if len(classes) else np.zeros(0, dtype=np.int64)
    rows = [present[classes == number][:most] for number in np.flatnonzero(sizes >= count)]
    if not rows:
        raise ValueError(
            f"no class has {count} members or more (the largest has {sizes.max(initial=0)}): ask for fewer"
        )
    return np.sort(np.concatenate(rows))


def cluster_table(
    table: FeatureTable,
    label: str,
    *,
    factors: Sequence[str] | None = ("geometry", "albedo"),
    mean_by: Sequence[str] = (),
    min_count: int = 1,
    max_count: int | None = None,
    n_clusters: int | None = None,
    seeds: Iterable[int] = SEEDS,
) -> ClusteringResult:
    """The protocol on a FeatureTable.

    Args:
        table: features and labels.
        label: the label column that gives the classes.
        factors: whose features, side by side (the paper: geometry and albedo); None means all.
        mean_by: average the features first over rows that share these labels, as for face tracks.
        min_count: leave out classes with fewer rows.
        max_count: keep at most that many rows of a class, the first ones.
        n_clusters: by default as many as there are classes.
        seeds: for the chance level.
    """
    dropped = 0
    if mean_by:
        dropped = int(np.any([missing(table.label(name)) for name in (*mean_by, label)], axis=0).sum())
        table = table.select(~missing(table.label(label))).mean_by(*mean_by)
        if label not in table.labels:
            raise ValueError(
                f"label {label!r} differs inside groups of {', '.join(mean_by)}: average by it too"
            )
    labels = table.label(label)
    if min_count > 1 or max_count is not None:
        rows = np.union1d(at_least(labels, min_count, max_count), np.flatnonzero(missing(labels)))
        table, labels = table.select(rows), labels[rows]
    result = evaluate_clustering(table.concatenate(factors), labels, n_clusters, seeds)
    return replace(result, n_dropped=result.n_dropped + dropped)
