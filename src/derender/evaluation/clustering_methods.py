"""Ways to cluster by name: one fit gives every number of clusters asked for.

``ward`` and ``finch`` build one hierarchy and cut it, so forty attributes cost one tree; ``k-means``
(scikit-learn, Euclidean, ten starts) is fitted anew for each number. Ward is Euclidean as in the paper, FINCH
cosine as in its paper. Above ``EXACT_ROWS`` rows all are approximate, and ``approximation`` says how.

FINCH: Sarfraz, Sharma and Stiefelhagen, CVPR 2019 (the paper's appendix uses it), with cosine distance. Every
row is linked to its nearest other row; the connected parts are the clusters; their means are the rows of the
next level. A level that takes away at most one cluster, or leaves only one, ends the hierarchy, as in the
authors' package `finch-clust`. That package holds several N x N arrays (1.6 GB each for 20,000 rows); here
neighbours are exact in bounded memory up to 100,000 rows, and come from near cells above (neighbours.py).
Tests compare the two. Leaves out its cut of long links, which has no effect in it.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from sklearn.cluster import KMeans, MiniBatchKMeans

from derender.evaluation import neighbours
from derender.evaluation.memory import Memory
from derender.evaluation.neighbours import finite_rows, nearest_rows, unit_rows
from derender.evaluation.ward import (
    LEAVES,
    LeafTree,
    by_appearance,
    cut,
    cut_leaves,
    ward_in_cells,
    ward_tree,
)
from derender.features import named

METHODS = {"ward": "Ward clustering", "finch": "FINCH clustering", "k-means": "k-means"}
"""By name, as tables call it."""
_MINI_BATCH = 16_384


@dataclass(frozen=True)
class FinchHierarchy:
    """Partitions from fine to coarse: each (N,) integers from 0, numbered by first appearance."""

    partitions: tuple[np.ndarray, ...]

    @property
    def counts(self) -> tuple[int, ...]:
        """The number of clusters of each partition."""
        return tuple(int(partition.max()) + 1 for partition in self.partitions)


def approximation(method: str, n_rows: int) -> str:
    """How a method is approximate with so many rows, in a few words; "" where it is exact."""
    if n_rows <= neighbours.EXACT_ROWS:
        return ""
    how = {
        "ward": f"Ward inside cells of near rows, then over the {LEAVES:,} clusters they leave",
        "finch": "nearest rows are looked for in near cells only",
        "k-means": f"mini-batches of {_MINI_BATCH:,} rows",
    }[method]
    return f"{n_rows:,} rows are more than {neighbours.EXACT_ROWS:,}, so {method} is approximate: {how}"


def clusterings(
    features: np.ndarray,
    counts: Iterable[int],
    method: str = "ward",
    *,
    seed: int = 0,
    memory: Memory | None = None,
) -> dict[int, np.ndarray]:
    """Cluster finite (N, D) features into each of the numbers in ``counts``: by number, (N,) integers.

    ``method`` is one of ``METHODS``, ``seed`` for the starts of k-means, ``memory`` the cache of the trees.
    """
    memory, wanted = memory or Memory(), sorted(set(counts))
    features = finite_rows(features, "clustering")
    named(METHODS, method, "method")
    for count in wanted:
        if not 1 <= count <= len(features):
            raise ValueError(
                f"cannot make {count} clusters of {len(features)} rows: ask for 1 to {len(features)}"
            )
    inputs = {"features": features}
    if method == "finch":
        hierarchy = finch_hierarchy(features, memory)
        return {count: finch_clusters(features, count, hierarchy) for count in wanted}
    if method == "ward" and len(features) > neighbours.EXACT_ROWS:
        leaves = LeafTree(**memory.recall("ward-cells", inputs, lambda: vars(ward_in_cells(features))))
        return {count: cut_leaves(leaves, count) for count in wanted}
    if method == "ward":
        tree = memory.recall_one("ward", inputs, lambda: ward_tree(features))
        return {count: cut(tree, count) for count in wanted}

    def k_means(count: int) -> np.ndarray:
        how: dict[str, Any] = {"n_clusters": count, "n_init": 10, "random_state": seed}
        many = len(features) > neighbours.EXACT_ROWS
        means = MiniBatchKMeans(batch_size=_MINI_BATCH, **how) if many else KMeans(**how)
        return np.asarray(means.fit(features.astype(np.float32, copy=False)).labels_, np.int64)

    found = {}
    for count in wanted:
        known = {**inputs, "seed": seed, "clusters": count}
        found[count] = memory.recall_one("k-means", known, partial(k_means, count))
    return found


def finch_hierarchy(features: np.ndarray, memory: Memory | None = None) -> FinchHierarchy:
    """FINCH's partitions, cached."""
    features = finite_rows(features, "FINCH")
    found = (memory or Memory()).recall_one(
        "finch", {"features": features}, lambda: np.array(finch(features).partitions)
    )
    return FinchHierarchy(tuple(found))


def finch(features: np.ndarray) -> FinchHierarchy:
    """FINCH's whole hierarchy over the rows of (N, D) features."""
    features = finite_rows(features, "FINCH")
    partitions = [_linked(features)]
    while (count := int(partitions[-1].max()) + 1) > 1:
        groups = _linked(_means(features, partitions[-1]))
        left = int(groups.max()) + 1
        if left == 1 or count - left <= 1:
            break
        partitions.append(groups[partitions[-1]])
    return FinchHierarchy(tuple(map(by_appearance, partitions)))


def finch_clusters(
    features: np.ndarray, n_clusters: int, hierarchy: FinchHierarchy | None = None
) -> np.ndarray:
    """FINCH with a required number of clusters: (N,) integers.

    Starts at the coarsest partition with at least as many and merges the two clusters of nearest means, one
    pair at a time. ``hierarchy`` saves computing it again.

    Raises:
        ValueError: more clusters than the finest partition has: FINCH cannot make them.
    """
    features = finite_rows(features, "FINCH")
    hierarchy = hierarchy or finch(features)
    if not 1 <= n_clusters <= hierarchy.counts[0]:
        raise ValueError(
            f"FINCH's finest partition of {len(features)} rows has {hierarchy.counts[0]} clusters, "
            f"cannot make {n_clusters}: ask for 1 to {hierarchy.counts[0]}, or use Ward"
        )
    level = max(number for number, count in enumerate(hierarchy.counts) if count >= n_clusters)
    partition, merges = hierarchy.partitions[level], hierarchy.counts[level] - n_clusters
    return by_appearance(_merged(features, partition, merges)[partition]) if merges else partition


def _linked(rows: np.ndarray) -> np.ndarray:
    """Connected parts of the links from each row to its nearest."""
    count = len(rows)
    links = csr_array((np.ones(count), (np.arange(count), nearest_rows(rows)[0])), shape=(count, count))
    return connected_components(links, directed=True, connection="weak")[1]


def _means(features: np.ndarray, partition: np.ndarray) -> np.ndarray:
    sizes = np.bincount(partition)
    member = csr_array((np.ones(len(partition)), (partition, np.arange(len(partition)))))
    return (member @ features / sizes[:, None]).astype(features.dtype, copy=False)


def _merged(features: np.ndarray, partition: np.ndarray, merges: int) -> np.ndarray:
    """The cluster that each becomes when the nearest pair of means is merged so many times.

    Only clusters that a merge touches look for their nearest again.
    """
    means, sizes = _means(features, partition), np.bincount(partition).astype(np.float64)
    alive, into = np.ones(len(means), bool), np.arange(len(means))
    nearest, distance = nearest_rows(means)
    for _ in range(merges):
        pair = int(np.where(alive, distance, np.inf).argmin())
        first, second = sorted((pair, int(nearest[pair])))
        means[first] += (means[second] - means[first]) * sizes[second] / (sizes[first] + sizes[second])
        sizes[first] += sizes[second]
        alive[second], into[into == second] = False, first
        others = np.flatnonzero(alive)
        if len(others) < 2:
            break
        touched = alive & ((nearest == first) | (nearest == second))
        touched[first] = True
        rows = np.flatnonzero(touched)
        gaps = 1 - unit_rows(means[rows]) @ unit_rows(means[others]).T
        gaps[rows[:, None] == others] = np.inf
        at = gaps.argmin(axis=1)
        nearest[rows], distance[rows] = others[at], gaps[np.arange(len(rows)), at]
        gap = 1 - unit_rows(means[others]) @ unit_rows(means[[first]])[0]
        closer = (gap < distance[others]) & (others != first)
        nearest[others[closer]], distance[others[closer]] = first, gap[closer]
    return into
