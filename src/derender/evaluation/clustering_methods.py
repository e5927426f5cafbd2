"""Ways to cluster by name: one fit gives every number of clusters asked for.

``ward`` and ``finch`` build one hierarchy and cut it: forty attributes cost one tree. ``k-means``
(scikit-learn, Euclidean, ten starts) is fitted anew for each number. Ward is Euclidean as in the paper, FINCH
cosine as in its paper. Above ``EXACT_ROWS`` rows all are approximate, and ``approximation`` says how.

FINCH: Sarfraz, Sharma and Stiefelhagen, CVPR 2019 (the paper's appendix uses it). Every row is linked to its
nearest other row; the connected parts are the clusters; their means are the rows of the next level. A level
that takes away at most one cluster, or leaves only one, ends the hierarchy. So it does in `finch-clust`,
which holds several N x N arrays. Leaves out its cut of long links, which has no effect in it.

Ward's criterion (1963) is reducible (Bruynooghe 1977): a merged pair is never nearer to a third cluster than
the nearer of its parts was. So all pairs that are each other's nearest neighbour are merged at once, and only
those rows look again whose neighbour was merged. Distances are made block by block and forgotten: SciPy's
``linkage`` holds N(N-1)/2 of them, 10 GB for 50,000 rows.

``ward_in_cells`` builds Ward's exact tree inside every cell of near rows (neighbours.py). Of all merges the
cheapest are made until ``LEAVES`` clusters are left, and Ward's exact tree is built over these. No merge
before the leaves goes over a cell's border.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from derender.evaluation import neighbours
from derender.evaluation.memory import Memory
from derender.features import named

FLOAT64_ROWS = 20_000  # above, nearest neighbours are looked up in float32; heights are always float64
NUMBERS_AT_ONCE = 1 << 20
LEAVES = 16_384  # clusters that the cells leave; more cannot be asked for


def ward_tree(features: np.ndarray, sizes: np.ndarray | None = None) -> np.ndarray:
    """Ward's tree over the rows of (N, D) features: (N-1, 4) merges in SciPy's form, to be cut.

    With ``sizes``, (N,), each row is the mean of so many.

    Columns: the two clusters merged (rows are 0..N-1, the k-th merge makes N+k), their distance, the number
    of rows. The distance is sqrt(2ab/(a+b)) times that of the means, as in SciPy. The means of N rows are all
    it holds, and one block of distances.
    """
    means = neighbours.finite_rows(features, "Ward clustering").astype(np.float64, copy=False)
    means = means - means.mean(axis=0)  # keeps the distances, and more of their digits
    count = len(means)
    sizes = np.ones(count) if sizes is None else np.array(sizes, np.float64)
    dtype = np.float64 if count <= FLOAT64_ROWS else np.float32
    cluster, height = np.arange(count), np.zeros(count)  # of each place: number, height it was made at
    nearest, distance = np.zeros(count, np.int64), np.zeros(count)
    stale, merges, done = np.arange(count), [], 0
    while True:
        _look(means, sizes, stale, nearest, distance, dtype)
        alive, places = sizes > 0, np.arange(len(sizes))
        first = np.flatnonzero((nearest[nearest] == places) & (places < nearest) & alive)
        if len(first) == 0:  # rounding left no pair that is each other's nearest
            first = np.array([np.where(alive, distance, np.inf).argmin()])
        second = nearest[first]
        gap = ((means[first] - means[second]) ** 2).sum(axis=1)
        total = sizes[first] + sizes[second]
        made = np.sqrt(2 * sizes[first] * sizes[second] / total * gap)
        made = np.maximum(made, np.maximum(height[first], height[second]))  # rounding only
        merges.append(np.column_stack((cluster[first], cluster[second], made, total)))
        means[first] += (means[second] - means[first]) * (sizes[second] / total)[:, None]
        sizes[first], sizes[second], height[first] = total, 0, made
        cluster[first] = count + done + np.arange(len(first))
        done += len(first)
        if done == count - 1:
            return _in_order(np.concatenate(merges), count)
        touched = np.isin(places, (first, second))
        stale = np.flatnonzero((touched | touched[nearest]) & (sizes > 0))
        if (sizes == 0).mean() > 0.1:  # rows that were merged away are removed
            kept = sizes > 0
            place = np.cumsum(kept) - 1
            means, sizes, cluster, height = means[kept], sizes[kept], cluster[kept], height[kept]
            nearest, distance, stale = place[nearest[kept]], distance[kept], place[stale]


def cut(tree: np.ndarray, n_clusters: int, leaf: np.ndarray | None = None) -> np.ndarray:
    """Cut a Ward tree into exactly ``n_clusters``: (N,) integers from 0, numbered by first appearance.

    The tree is over the rows, or over leaves; ``leaf``, (N,), is then the leaf of each row.
    """
    count, what = len(tree) + 1, "rows" if leaf is None else "leaves, which Ward by cells keeps"
    if not 1 <= n_clusters <= count:
        raise ValueError(f"cannot make {n_clusters} clusters of {count} {what}: ask for 1 to {count}")
    parent = np.arange(2 * count - 1)
    for step in range(count - n_clusters):
        parent[tree[step, :2].astype(np.int64)] = count + step
    root = np.arange(count) if leaf is None else leaf
    while not np.array_equal(parent[root], root):
        root = parent[root]
    return by_appearance(root)


def by_appearance(names: np.ndarray) -> np.ndarray:
    """Any names as integers from 0 in the order in which they first appear."""
    _, first, cluster = np.unique(names, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[cluster]


def ward_in_cells(
    features: np.ndarray, leaves: int = LEAVES, rows_per_cell: int = neighbours.CELL_ROWS
) -> dict[str, np.ndarray]:
    """Approximate Ward over the rows of (N, D) features: ``tree`` and ``leaf``, as ``cut`` takes them."""
    points = neighbours.finite_rows(features, "Ward clustering").astype(np.float32, copy=False)
    groups = neighbours.cells(points, rows_per_cell)
    trees = neighbours.of_each(lambda cell: _tree(points[groups[cell]]), groups)
    # the cheapest merges of all cells are made until so many clusters are left
    heights = np.concatenate([tree[:, 2] for tree in trees])
    cell = np.repeat(np.arange(len(groups)), [len(tree) for tree in trees])
    merges = max(0, len(points) - max(min(leaves, len(points)), len(groups)))
    merged = np.bincount(cell[np.argsort(heights, kind="stable")[:merges]], minlength=len(groups))
    leaf, made = np.zeros(len(points), np.int64), 0
    for rows, tree, fewer in zip(groups, trees, merged.tolist(), strict=True):
        leaf[rows] = made + cut(tree, len(rows) - fewer)
        made += len(rows) - fewer
    sizes, sums = np.bincount(leaf, minlength=made), np.zeros((made, points.shape[1]))
    for rows in np.array_split(np.argsort(leaf, kind="stable"), max(1, len(points) // 65_536)):
        held, first = np.unique(leaf[rows], return_index=True)
        sums[held] += np.add.reduceat(points[rows].astype(np.float64), first, axis=0)
    return {"leaf": leaf, "tree": _tree(sums / sizes[:, None], sizes)}


def _tree(points: np.ndarray, sizes: np.ndarray | None = None) -> np.ndarray:
    return ward_tree(points, sizes) if len(points) > 1 else np.zeros((0, 4))


def _look(
    means: np.ndarray, sizes: np.ndarray, stale: np.ndarray, nearest: np.ndarray, distance: np.ndarray, dtype
) -> None:
    """Write the nearest neighbour of the rows ``stale``, and Ward's distance to it, squared and halved."""
    points = means.astype(dtype, copy=False)
    square = np.where(sizes > 0, np.einsum("nd,nd->n", means, means), np.inf).astype(dtype)
    with np.errstate(divide="ignore"):
        inverse = np.where(sizes > 0, 1 / sizes, 1).astype(dtype)
    at_once = max(1, NUMBERS_AT_ONCE // len(points))
    for start in range(0, len(stale), at_once):
        rows = stale[start : start + at_once]
        block = points[rows] * -2 @ points.T
        block += square
        block += square[rows, None]
        np.maximum(block, 0, out=block)
        block /= inverse[rows, None] + inverse
        block[np.arange(len(rows)), rows] = np.inf
        nearest[rows] = block.argmin(axis=1)
        distance[rows] = block[np.arange(len(rows)), nearest[rows]]


def _in_order(merges: np.ndarray, count: int) -> np.ndarray:
    """Merges by height; clusters numbered anew, as they come then. A part is never behind the whole."""
    order = np.argsort(merges[:, 2], kind="stable")
    number = np.arange(2 * count - 1)
    number[count + order] = count + np.arange(len(order))
    tree = merges[order]
    tree[:, :2] = np.sort(number[tree[:, :2].astype(np.int64)], axis=1)
    return tree


METHODS = {"ward": "Ward clustering", "finch": "FINCH clustering", "k-means": "k-means"}  # as in tables
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
    features: np.ndarray, counts: Iterable[int], method: str = "ward", *, seed: int = 0,
    memory: Memory | None = None,
) -> dict[int, np.ndarray]:  # fmt: skip
    """Cluster finite (N, D) features into each of the numbers in ``counts``: by number, (N,) integers.

    ``method`` is one of ``METHODS``, ``seed`` for the starts of k-means, ``memory`` the cache of the trees.
    """
    memory, wanted = memory or Memory(), sorted(set(counts))
    features = neighbours.finite_rows(features, "clustering")
    rows = len(features)
    named(METHODS, method, "method")
    for count in wanted:
        if not 1 <= count <= rows:
            raise ValueError(f"cannot make {count} clusters of {rows} rows: ask for 1 to {rows}")
    inputs = {"features": features}
    if method == "finch":
        hierarchy = finch(features, memory)
        return {count: finch_clusters(features, count, hierarchy) for count in wanted}
    if method == "ward" and rows > neighbours.EXACT_ROWS:
        result = memory.recall("ward-cells", inputs, lambda: ward_in_cells(features))
        return {count: cut(n_clusters=count, **result) for count in wanted}
    if method == "ward":
        tree = memory.recall_one("ward", inputs, lambda: ward_tree(features))
        return {count: cut(tree, count) for count in wanted}

    def k_means(count: int) -> np.ndarray:
        from sklearn.cluster import KMeans, MiniBatchKMeans

        how: dict[str, Any] = {"n_clusters": count, "n_init": 10, "random_state": seed}
        exact = rows <= neighbours.EXACT_ROWS
        means = KMeans(**how) if exact else MiniBatchKMeans(batch_size=_MINI_BATCH, **how)
        return np.asarray(means.fit(features.astype(np.float32, copy=False)).labels_, np.int64)

    keys = {count: {**inputs, "seed": seed, "clusters": count} for count in wanted}
    return {count: memory.recall_one("k-means", key, partial(k_means, count)) for count, key in keys.items()}


def finch(features: np.ndarray, memory: Memory | None = None) -> FinchHierarchy:
    """FINCH's whole hierarchy over the rows of (N, D) features, cached in ``memory``."""
    features = neighbours.finite_rows(features, "FINCH")

    def make() -> np.ndarray:
        partitions = [_linked(features)]
        while (count := int(partitions[-1].max()) + 1) > 1:
            groups = _linked(_means(features, partitions[-1]))
            left = int(groups.max()) + 1
            if left == 1 or count - left <= 1:
                break
            partitions.append(groups[partitions[-1]])
        return np.array(list(map(by_appearance, partitions)))

    return FinchHierarchy(tuple((memory or Memory()).recall_one("finch", {"features": features}, make)))


def finch_clusters(
    features: np.ndarray, n_clusters: int, hierarchy: FinchHierarchy | None = None
) -> np.ndarray:
    """FINCH with a required number of clusters: (N,) integers.

    Starts at the coarsest partition with at least as many and merges the two clusters of nearest means, one
    pair at a time. ``hierarchy`` saves computing it again.

    Raises:
        ValueError: more clusters than the finest partition has: FINCH cannot make them.
    """
    features = neighbours.finite_rows(features, "FINCH")
    hierarchy = hierarchy or finch(features)
    if not 1 <= n_clusters <= (most := hierarchy.counts[0]):
        what = f"FINCH's finest partition of {len(features)} rows has {most} clusters"
        raise ValueError(f"{what}, cannot make {n_clusters}: ask for 1 to {most}, or use Ward")
    partition = [part for part in hierarchy.partitions if part.max() + 1 >= n_clusters][-1]
    means, sizes = _means(features, partition), np.bincount(partition)
    while len(means) > n_clusters:
        nearest, distance = neighbours.nearest_rows(means)
        pair = distance.argmin()
        first, second = sorted((pair, nearest[pair]))
        means[first] += (means[second] - means[first]) * sizes[second] / (sizes[first] + sizes[second])
        sizes[first] += sizes[second]
        means, sizes = np.delete(means, second, axis=0), np.delete(sizes, second)
        partition = np.where(partition == second, first, partition)
        partition -= partition > second
    return by_appearance(partition)


def _linked(rows: np.ndarray) -> np.ndarray:
    """Connected parts of the links from each row to its nearest."""
    count, nearest = len(rows), neighbours.nearest_rows(rows)[0]
    links = csr_array((np.ones(count), (np.arange(count), nearest)), shape=(count, count))
    return connected_components(links, directed=True, connection="weak")[1]


def _means(features: np.ndarray, partition: np.ndarray) -> np.ndarray:
    sizes = np.bincount(partition)
    member = csr_array((np.ones(len(partition)), (partition, np.arange(len(partition)))))
    return (member @ features / sizes[:, None]).astype(features.dtype, copy=False)
