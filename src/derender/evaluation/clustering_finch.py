"""FINCH: a hierarchy of partitions from first neighbours alone; no number of clusters is given.

Source: Sarfraz, Sharma and Stiefelhagen, CVPR 2019 (the paper's appendix uses it). Every row is linked to
its nearest other row; the connected parts are the clusters; their means are the rows of the next level. As
in the authors' package `finch-clust`, a level that takes away at most one cluster, or leaves only one, ends
the hierarchy. Written anew because that package holds several N x N arrays (1.6 GB each for 20,000 rows)
and approximates above; here neighbours are exact in bounded memory up to 100,000 rows, and come from near
cells above (evaluation/neighbours.py). Tests compare the two. Leaves out that
package's cut of long links, which has no effect in it (SciPy takes a stored zero for a link).
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from derender.evaluation.clustering_ward import by_appearance
from derender.evaluation.neighbours import Metric, finite_rows, nearest_rows, prepared


@dataclass(frozen=True)
class FinchHierarchy:
    """Partitions from fine to coarse.

    Attributes:
        partitions: each (N,) integers from 0, numbered by first appearance.
        counts: the number of clusters of each.
    """

    partitions: tuple[np.ndarray, ...]
    counts: tuple[int, ...]


def finch(features: np.ndarray, metric: Metric = "cosine") -> FinchHierarchy:
    """FINCH's whole hierarchy over the rows of (N, D) features."""
    features = finite_rows(features, "FINCH")
    partitions = [_linked(nearest_rows(features, metric)[0])]
    while True:
        fine = partitions[-1]
        count = int(fine.max()) + 1
        if count < 2:
            break
        groups = _linked(nearest_rows(_means(features, fine), metric)[0])
        left = int(groups.max()) + 1
        if left == 1 or count - left <= 1:
            break
        partitions.append(groups[fine])
    return FinchHierarchy(
        tuple(by_appearance(partition) for partition in partitions),
        tuple(int(partition.max()) + 1 for partition in partitions),
    )


def finch_clusters(
    features: np.ndarray,
    n_clusters: int,
    metric: Metric = "cosine",
    hierarchy: FinchHierarchy | None = None,
) -> np.ndarray:
    """FINCH with a required number of clusters: (N,) integers.

    Starts at the coarsest partition with at least as many and merges the two clusters of nearest means, one
    pair at a time. ``hierarchy`` saves computing it again.

    Raises:
        ValueError: more clusters than the finest partition has: FINCH cannot make them.
    """
    features = finite_rows(features, "FINCH")
    hierarchy = hierarchy or finch(features, metric)
    if not 1 <= n_clusters <= hierarchy.counts[0]:
        raise ValueError(
            f"FINCH's finest partition of {len(features)} rows has {hierarchy.counts[0]} clusters, "
            f"cannot make {n_clusters}: ask for 1 to {hierarchy.counts[0]}, or use Ward"
        )
    level = max(number for number, count in enumerate(hierarchy.counts) if count >= n_clusters)
    partition = hierarchy.partitions[level]
    return _merged(features, partition, hierarchy.counts[level] - n_clusters, metric)


def _linked(nearest: np.ndarray) -> np.ndarray:
    """Connected parts of the links row -> nearest."""
    rows = np.arange(len(nearest))
    links = csr_array((np.ones(len(rows)), (rows, nearest)), shape=(len(rows), len(rows)))
    return connected_components(links, directed=True, connection="weak")[1]


def _means(features: np.ndarray, partition: np.ndarray) -> np.ndarray:
    sizes = np.bincount(partition)
    member = csr_array((np.ones(len(partition)), (partition, np.arange(len(partition)))))
    return (member @ features / sizes[:, None]).astype(features.dtype, copy=False)


def _merged(features: np.ndarray, partition: np.ndarray, merges: int, metric: Metric) -> np.ndarray:
    """Merge the nearest pair of means so many times; only what a merge touches is looked up again."""
    means, sizes = _means(features, partition), np.bincount(partition).astype(np.float64)
    alive, into = np.ones(len(means), bool), np.arange(len(means))
    if not merges:
        return partition
    nearest, distance = nearest_rows(means, metric)
    for _ in range(merges):
        first = int(np.where(alive, distance, np.inf).argmin())
        second = int(nearest[first])
        first, second = min(first, second), max(first, second)
        means[first] += (means[second] - means[first]) * sizes[second] / (sizes[first] + sizes[second])
        sizes[first] += sizes[second]
        alive[second], into[into == second] = False, first
        touched = alive & ((nearest == first) | (nearest == second))
        touched[first] = True
        others = np.flatnonzero(alive)
        if len(others) < 2:
            break
        _look_again(means, np.flatnonzero(touched), others, nearest, distance, metric)
        gap = _gaps(means[[first]], means[others], metric)[0]
        closer = (gap < distance[others]) & (others != first)
        nearest[others[closer]], distance[others[closer]] = first, gap[closer]
    return by_appearance(into[partition])


def _look_again(
    means: np.ndarray,
    rows: np.ndarray,
    others: np.ndarray,
    nearest: np.ndarray,
    distance: np.ndarray,
    metric: Metric,
) -> None:
    gaps = _gaps(means[rows], means[others], metric)
    gaps[rows[:, None] == others] = np.inf
    at = gaps.argmin(axis=1)
    nearest[rows], distance[rows] = others[at], gaps[np.arange(len(rows)), at]


def _gaps(a: np.ndarray, b: np.ndarray, metric: Metric) -> np.ndarray:
    if metric == "cosine":
        return 1 - prepared(a, metric) @ prepared(b, metric).T
    square = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2 * a @ b.T
    return np.sqrt(np.maximum(square, 0))
