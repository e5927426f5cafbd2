"""Ways to cluster by name: one fit gives every number of clusters asked for.

``ward`` and ``finch`` build one hierarchy and cut it, so forty attributes cost one tree; ``k-means``
(scikit-learn, Euclidean, ten starts) fits anew for each number. Ward is Euclidean as in the paper, FINCH
cosine as in its paper.
"""

from collections.abc import Iterable

import numpy as np
from sklearn.cluster import KMeans

from derender.data.nearest import nearest
from derender.evaluation.clustering_finch import FinchHierarchy, finch, finch_clusters
from derender.evaluation.clustering_ward import cut, ward_tree
from derender.evaluation.memory import Memory
from derender.evaluation.neighbours import finite_rows

METHODS = ("ward", "finch", "k-means")


def clusterings(
    features: np.ndarray,
    counts: Iterable[int],
    method: str = "ward",
    *,
    seed: int = 0,
    memory: Memory | None = None,
) -> dict[int, np.ndarray]:
    """Cluster (N, D) features into each of the numbers in ``counts``: by number, (N,) integers.

    Args:
        features: finite.
        counts: numbers of clusters.
        method: "ward", "finch" or "k-means".
        seed: for the starts of k-means.
        memory: where trees are kept.
    """
    memory, wanted = memory or Memory(), sorted(set(counts))
    features = finite_rows(features, "clustering")
    _check(method, wanted, len(features))
    if method == "ward":
        tree = memory.recall("ward", {"features": features}, lambda: {"tree": ward_tree(features)})["tree"]
        return {count: cut(tree, count) for count in wanted}
    if method == "finch":
        hierarchy = finch_hierarchy(features, memory)
        return {count: finch_clusters(features, count, hierarchy=hierarchy) for count in wanted}
    inputs = {"features": features, "seed": seed}
    return {
        count: memory.recall(
            "k-means", {**inputs, "clusters": count}, lambda count=count: _k_means(features, count, seed)
        )["clusters"]
        for count in wanted
    }


def finch_hierarchy(features: np.ndarray, memory: Memory | None = None) -> FinchHierarchy:
    """FINCH's partitions, remembered."""
    features = finite_rows(features, "FINCH")

    def make() -> dict[str, np.ndarray]:
        return {"partitions": np.array(finch(features).partitions)}

    partitions = (memory or Memory()).recall("finch", {"features": features}, make)["partitions"]
    return FinchHierarchy(tuple(partitions), tuple(int(partition.max()) + 1 for partition in partitions))


def _k_means(features: np.ndarray, count: int, seed: int) -> dict[str, np.ndarray]:
    means = KMeans(count, n_init=10, random_state=seed)  # pyright: ignore[reportArgumentType]
    fitted = means.fit(features.astype(np.float32))
    return {"clusters": np.asarray(fitted.labels_, np.int64)}


def _check(method: str, counts: list[int], n_rows: int) -> None:
    if method not in METHODS:
        raise ValueError(
            f"unknown method {method!r}{nearest(method, METHODS)}; there is {', '.join(METHODS)}"
        )
    for count in counts:
        if not 1 <= count <= n_rows:
            raise ValueError(f"cannot make {count} clusters of {n_rows} rows: ask for 1 to {n_rows}")
