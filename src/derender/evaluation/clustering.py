"""Clustering protocol: do features group pictures by a label that training never saw?

Source: Klinghoffer et al., ECCV 2022, Sec. 4: Ward's hierarchical clustering with as many clusters as
classes; accuracy is weighted purity; F1 is weighted F1 after each cluster took its majority label; NMI.
Beside these stand Hungarian accuracy and ARI, and for every score its chance level: the same clusters'
sizes with rows dealt at random. Purity and NMI of random clusters are far from 0, and purity of one cluster
is the majority's share: read no score without its chance. Leaves out k-means, FINCH and approximate trees.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from scipy.cluster.hierarchy import linkage
from scipy.optimize import linear_sum_assignment
from sklearn.metrics import adjusted_rand_score, normalized_mutual_info_score
from sklearn.metrics.cluster import contingency_matrix

from derender.features import FeatureTable, missing

MAX_ROWS = 20_000  # the distances of 20,000 rows take 1.6 GB
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


def cluster_scores(labels: np.ndarray, assignment: np.ndarray) -> ClusterScores:
    """Score any clustering of labelled rows; names of clusters and classes do not matter.

    Args:
        labels: (N,) classes, none missing.
        assignment: (N,) cluster of each row.
    """
    classes, assignment = _encoded(labels), np.asarray(assignment)
    if assignment.shape != classes.shape:
        raise ValueError(f"labels {classes.shape} and assignment {assignment.shape} must be of one length")
    if len(classes) == 0:
        raise ValueError("nothing to score: no rows")
    clusters = np.unique(assignment, return_inverse=True)[1]
    counts = np.asarray(contingency_matrix(classes, clusters))
    matched = counts[linear_sum_assignment(counts, maximize=True)].sum()
    return ClusterScores(
        accuracy=float(counts.max(axis=0).sum() / len(classes)),
        f1=_majority_f1(counts),
        nmi=float(normalized_mutual_info_score(classes, clusters)),
        hungarian=float(matched / len(classes)),
        ari=float(adjusted_rand_score(classes, clusters)),
    )


def ward_tree(features: np.ndarray) -> np.ndarray:
    """Ward's tree over the rows of (N, D) features: (N-1, 4) merges in SciPy's form, to be cut."""
    features = np.asarray(features, dtype=np.float64)
    if features.ndim != 2:
        raise ValueError(f"features must be (rows, dimensions), got shape {features.shape}")
    if not np.isfinite(features).all():
        bad = int((~np.isfinite(features).all(axis=1)).sum())
        raise ValueError(
            f"features are not finite in {bad} of {len(features)} rows: drop these rows or check the model"
        )
    if not 2 <= len(features) <= MAX_ROWS:
        raise ValueError(
            f"Ward clustering takes 2 to {MAX_ROWS} rows, got {len(features)}: select a part of the rows"
        )
    return linkage(features, method="ward")


def cut(tree: np.ndarray, n_clusters: int) -> np.ndarray:
    """Cut a Ward tree into exactly ``n_clusters``: (N,) integers from 0, numbered by first appearance."""
    n_rows = len(tree) + 1
    if not 1 <= n_clusters <= n_rows:
        raise ValueError(f"cannot make {n_clusters} clusters of {n_rows} rows: ask for 1 to {n_rows}")
    parent = np.arange(2 * n_rows - 1)
    for step in range(n_rows - n_clusters):
        parent[tree[step, :2].astype(np.int64)] = n_rows + step
    root = np.arange(n_rows)
    while not np.array_equal(parent[root], root):
        root = parent[root]
    _, first, cluster = np.unique(root, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[cluster]


def ward(features: np.ndarray, n_clusters: int) -> np.ndarray:
    """Ward clustering of (N, D) features into ``n_clusters``: (N,) integers."""
    return cut(ward_tree(features), n_clusters)


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
    values = np.array([[getattr(deal, f.name) for f in fields(ClusterScores)] for deal in deals])
    return ClusterScores(*values.mean(axis=0).tolist()), ClusterScores(*values.std(axis=0).tolist())


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
    counts = np.bincount(_encoded(labels)) if len(labels) else np.zeros(0, dtype=np.int64)
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
    classes = _encoded(labels[present])
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
    return result if not dropped else _with_dropped(result, dropped)


def _majority_f1(counts: np.ndarray) -> float:
    """Weighted F1 of clusters that answer their majority label, from the (classes, clusters) table."""
    majority = counts.argmax(axis=0)
    answered, right = np.zeros(len(counts)), np.zeros(len(counts))
    np.add.at(answered, majority, counts.sum(axis=0))
    np.add.at(right, majority, counts.max(axis=0))
    true = counts.sum(axis=1)
    return float((true * 2 * right / (answered + true)).sum() / true.sum())


def _with_dropped(result: ClusteringResult, count: int) -> ClusteringResult:
    values = {f.name: getattr(result, f.name) for f in fields(result)}
    return ClusteringResult(**{**values, "n_dropped": result.n_dropped + count})


def _encoded(labels: np.ndarray) -> np.ndarray:
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
