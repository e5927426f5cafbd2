"""Ward's clustering of very many rows: exact inside small cells, then exact over what the cells leave.

Near rows come into one cell (evaluation/cells.py). Every cell gets Ward's exact tree of its own; of all
merges the cheapest are made until ``LEAVES`` clusters are left. Ward's exact tree is then built over
their means and sizes. What is lost: no merge before the leaves goes over a cell's border.
"""

from dataclasses import dataclass

import numpy as np

from derender.evaluation.cells import CELL_ROWS, cells, members, of_each
from derender.evaluation.clustering_ward import by_appearance, cut, ward_tree
from derender.evaluation.neighbours import finite_rows

LEAVES = 16_384
"""Clusters that the cells leave; more cannot be asked for."""


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
    features = finite_rows(features, "Ward clustering")
    points = features.astype(np.float32, copy=False)
    groups = members(cells(points, rows_per_cell, seed))
    trees = list(of_each(lambda cell: _tree(points[groups[cell]]), groups))
    kept = _counts([tree[:, 2] for tree in trees], min(leaves, len(points)))
    leaf, made = np.zeros(len(points), np.int64), 0
    for rows, tree, count in zip(groups, trees, kept, strict=True):
        leaf[rows] = made + (cut(tree, count) if len(rows) > 1 else 0)
        made += count
    means, sizes = _means(points, leaf, made)
    return LeafTree(leaf, _tree(means, sizes))


def cut_leaves(found: LeafTree, n_clusters: int) -> np.ndarray:
    """Cut into exactly ``n_clusters``: (N,) integers from 0, numbered by first appearance."""
    leaves = len(found.tree) + 1
    if not 1 <= n_clusters <= leaves:
        raise ValueError(
            f"Ward by cells keeps {leaves} leaves of {len(found.leaf)} rows, cannot make {n_clusters} "
            f"clusters: ask for 1 to {leaves}"
        )
    top = cut(found.tree, n_clusters) if leaves > 1 else np.zeros(1, np.int64)
    return by_appearance(top[found.leaf])


def _tree(points: np.ndarray, sizes: np.ndarray | None = None) -> np.ndarray:
    return ward_tree(points, sizes) if len(points) > 1 else np.zeros((0, 4))


def _counts(heights: list[np.ndarray], leaves: int) -> list[int]:
    """Into how many clusters each cell is cut when the cheapest merges of all cells are made first."""
    merges = max(0, sum(len(one) + 1 for one in heights) - max(leaves, len(heights)))
    cell = np.repeat(np.arange(len(heights)), [len(one) for one in heights])
    cheapest = np.argsort(np.concatenate(heights), kind="stable")[:merges]
    made = np.bincount(cell[cheapest], minlength=len(heights))
    return [len(one) + 1 - int(done) for one, done in zip(heights, made, strict=True)]


def _means(points: np.ndarray, leaf: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean (float64) and number of rows of each leaf."""
    sizes = np.bincount(leaf, minlength=count)
    sums = np.zeros((count, points.shape[1]))
    for rows in np.array_split(np.argsort(leaf, kind="stable"), max(1, len(points) // 65_536)):
        held, first = np.unique(leaf[rows], return_index=True)
        sums[held] += np.add.reduceat(points[rows].astype(np.float64), first, axis=0)
    return sums / sizes[:, None], sizes
