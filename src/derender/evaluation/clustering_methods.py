"""Ways to cluster by name: one fit gives every number of clusters asked for.

``ward`` and ``finch`` build one hierarchy and cut it, so forty attributes cost one tree; ``k-means``
(scikit-learn, Euclidean, ten starts) is fitted anew for each number. Ward is Euclidean as in the paper, FINCH
cosine as in its paper. Above ``EXACT_ROWS`` rows all are approximate, and ``approximation`` says how.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
from sklearn.cluster import KMeans, MiniBatchKMeans

from derender.evaluation import neighbours
from derender.evaluation.finch import FinchHierarchy, finch, finch_clusters
from derender.evaluation.memory import Memory
from derender.evaluation.neighbours import finite_rows
from derender.evaluation.ward import LEAVES, LeafTree, cut, cut_leaves, ward_in_cells, ward_tree
from derender.features import named

METHODS = {"ward": "Ward clustering", "finch": "FINCH clustering", "k-means": "k-means"}
"""By name, as tables call it."""
_MINI_BATCH = 16_384


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

    return {
        count: memory.recall_one(
            "k-means", {**inputs, "seed": seed, "clusters": count}, lambda count=count: k_means(count)
        )
        for count in wanted
    }


def finch_hierarchy(features: np.ndarray, memory: Memory | None = None) -> FinchHierarchy:
    """FINCH's partitions, cached."""
    features = finite_rows(features, "FINCH")
    found = (memory or Memory()).recall_one(
        "finch", {"features": features}, lambda: np.array(finch(features).partitions)
    )
    return FinchHierarchy(tuple(found))
