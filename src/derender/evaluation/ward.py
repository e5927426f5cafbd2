"""Ward's tree, exact, in memory that grows with the rows and not with their square; by cells for very many.

Source: Ward (1963), the paper's clustering. Ward's criterion is reducible (Bruynooghe 1977): a merged pair is
never nearer to a third cluster than the nearer of its parts was. So all pairs that are each other's nearest
neighbour may be merged at once, and only those rows look again whose neighbour was merged. Clusters are kept
as mean and size, distances are made block by block with one matrix product and forgotten. SciPy's
``linkage`` finds the same tree from the N(N-1)/2 distances held in memory: 10 GB for 50,000 rows.

``ward_in_cells`` builds Ward's exact tree inside every cell of near rows (neighbours.py); of all merges the
cheapest are made until ``LEAVES`` clusters are left, and Ward's exact tree is built over their means and
sizes. No merge before the leaves goes over a cell's border.
"""

from dataclasses import dataclass

import numpy as np

from derender.evaluation.neighbours import CELL_ROWS, TILE, cells, finite_rows, members, of_each

FLOAT64_ROWS = 20_000  # above, nearest neighbours are looked up in float32; heights are always float64
COMPACT_AT = 0.1  # share of merged-away rows at which they are removed
LEAVES = 16_384
"""Clusters that the cells leave; more cannot be asked for."""


def ward_tree(features: np.ndarray, sizes: np.ndarray | None = None) -> np.ndarray:
    """Ward's tree over the rows of (N, D) features: (N-1, 4) merges in SciPy's form, to be cut.

    With ``sizes``, (N,), each row is the mean of so many.

    Columns: the two clusters merged (rows are 0..N-1, the k-th merge makes N+k), the distance at which
    (sqrt(2ab/(a+b)) times the distance of the means, as SciPy), the number of rows. The means of N rows are
    all it holds, and one block of distances.
    """
    means = finite_rows(features, "Ward clustering").astype(np.float64, copy=False)
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
        touched = np.zeros(len(means), bool)
        touched[first] = touched[second] = True
        stale = np.flatnonzero((touched | touched[nearest]) & (sizes > 0))
        if (sizes == 0).mean() > COMPACT_AT:
            kept = np.flatnonzero(sizes > 0)
            place = np.zeros(len(means), np.int64)
            place[kept] = np.arange(len(kept))
            means, sizes, cluster, height = means[kept], sizes[kept], cluster[kept], height[kept]
            nearest, distance, stale = place[nearest[kept]], distance[kept], place[stale]


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
    return by_appearance(root)


def by_appearance(names: np.ndarray) -> np.ndarray:
    """Any names as integers from 0 in the order in which they first appear."""
    _, first, cluster = np.unique(names, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[cluster]


@dataclass(frozen=True)
class LeafTree:
    """Ward's tree over leaves.

    Attributes:
        leaf: (N,) the leaf of each row, integers from 0.
        tree: (leaves - 1, 4) merges of leaves, as ``ward_tree`` gives them.
    """

    leaf: np.ndarray
    tree: np.ndarray


def ward_in_cells(
    features: np.ndarray, leaves: int = LEAVES, rows_per_cell: int = CELL_ROWS, seed: int = 0
) -> LeafTree:
    """Approximate Ward over the rows of (N, D) features; at most as many leaves as rows."""
    points = finite_rows(features, "Ward clustering").astype(np.float32, copy=False)
    groups = members(cells(points, rows_per_cell, seed))
    trees = list(of_each(lambda cell: _tree(points[groups[cell]]), groups))
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
    return LeafTree(leaf, _tree(sums / sizes[:, None], sizes))


def cut_leaves(found: LeafTree, n_clusters: int) -> np.ndarray:
    """Cut into exactly ``n_clusters``: (N,) integers from 0, numbered by first appearance."""
    leaves = len(found.tree) + 1
    if not 1 <= n_clusters <= leaves:
        raise ValueError(
            f"Ward by cells keeps {leaves} leaves of {len(found.leaf)} rows, cannot make {n_clusters} "
            f"clusters: ask for 1 to {leaves}"
        )
    return by_appearance(cut(found.tree, n_clusters)[found.leaf])


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
    for start in range(0, len(stale), TILE):
        rows = stale[start : start + TILE]
        own, best, where = points[rows] * -2, np.full(len(rows), np.inf, dtype), np.zeros(len(rows), np.int64)
        for left in range(0, len(points), TILE):
            columns = slice(left, left + TILE)
            block = own @ points[columns].T
            block += square[columns]
            block += square[rows, None]
            np.maximum(block, 0, out=block)
            block /= inverse[rows, None] + inverse[columns]
            inside = np.flatnonzero((rows >= left) & (rows < left + TILE))
            block[inside, rows[inside] - left] = np.inf
            at = block.argmin(axis=1)
            found = block[np.arange(len(rows)), at]
            better = found < best
            best[better], where[better] = found[better], at[better] + left
        nearest[rows], distance[rows] = where, best


def _in_order(merges: np.ndarray, count: int) -> np.ndarray:
    """Merges by height; clusters numbered anew, as they come then. A part is never behind the whole."""
    order = np.argsort(merges[:, 2], kind="stable")
    number = np.arange(2 * count - 1)
    number[count + order] = count + np.arange(len(order))
    tree = merges[order]
    tree[:, :2] = np.sort(number[tree[:, :2].astype(np.int64)], axis=1)
    return tree
