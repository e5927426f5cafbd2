"""Each row's nearest other row, without ever holding all distances: exactly, or by cells for very many rows.

Distances are made in square tiles with one matrix product each: memory is a copy of the rows and 8 MB.
Equally near rows: the first counts. Above ``EXACT_ROWS`` rows a row is compared with those of its own cell
and of the ``NEAR_CELLS`` nearest ones (evaluation/cells.py), and everything is float32.
"""

from typing import Literal

import numpy as np

from derender.evaluation.cells import CELL_ROWS, cells, members, of_each

Metric = Literal["cosine", "euclidean"]
TILE = 1024

EXACT_ROWS = 100_000
"""Up to so many rows all pairs are looked at."""

NEAR_CELLS = 4


def finite_rows(features: np.ndarray, purpose: str) -> np.ndarray:
    """(N, D) features as float64 (float32 above ``EXACT_ROWS`` rows), or an error that says what is wrong."""
    features = np.asarray(features)
    features = features.astype(np.float32 if len(features) > EXACT_ROWS else np.float64, copy=False)
    if features.ndim != 2:
        raise ValueError(f"features must be (rows, dimensions), got shape {features.shape}")
    if not np.isfinite(features).all():
        bad = int((~np.isfinite(features).all(axis=1)).sum())
        raise ValueError(
            f"features are not finite in {bad} of {len(features)} rows: drop these rows or check the model"
        )
    if len(features) < 2:
        raise ValueError(f"{purpose} takes 2 rows or more, got {len(features)}")
    return features


def prepared(points: np.ndarray, metric: Metric) -> np.ndarray:
    """Rows whose squared Euclidean distances are the metric's (cosine: twice 1 - cosine; a zero row is
    at distance 1 from all)."""
    if metric == "euclidean":
        return points - points.mean(axis=0)
    length = np.linalg.norm(points, axis=1, keepdims=True)
    return np.divide(points, length, out=np.zeros_like(points), where=length > 0)


def nearest_rows(points: np.ndarray, metric: Metric = "cosine") -> tuple[np.ndarray, np.ndarray]:
    """For each of (N, D) rows the nearest other row, (N,) integers, and the distance to it, (N,).

    Cosine distance is 1 - cosine, 0..2. Euclidean distance is not squared. Above ``EXACT_ROWS`` rows some
    are not the nearest: docs/scale.md says how many.
    """
    points = prepared(points, metric)
    if len(points) > EXACT_ROWS:
        return _nearest_in_cells(points.astype(np.float32, copy=False), metric)
    nearest, distance = np.zeros(len(points), np.int64), np.full(len(points), np.inf)
    for start in range(0, len(points), TILE):
        rows = slice(start, start + TILE)
        for left in range(0, len(points), TILE):
            block = _distances(points[rows], points[left : left + TILE], metric)
            if left == start:
                np.fill_diagonal(block, np.inf)
            at = block.argmin(axis=1)
            found = block[np.arange(len(block)), at]
            better = found < distance[rows]
            nearest[rows] = np.where(better, at + left, nearest[rows])
            distance[rows] = np.where(better, found, distance[rows])
    return nearest, distance


def _nearest_in_cells(points: np.ndarray, metric: Metric) -> tuple[np.ndarray, np.ndarray]:
    """``nearest_rows`` of prepared rows, compared with those of near cells only."""
    groups = members(cells(points, CELL_ROWS))
    centres = np.stack([points[rows].mean(axis=0) for rows in groups])
    square = (centres**2).sum(axis=1)
    apart = square[:, None] + square - 2 * centres @ centres.T
    np.fill_diagonal(apart, -np.inf)  # its own cell comes first
    near = np.argsort(apart, axis=1, kind="stable")[:, : NEAR_CELLS + 1]
    nearest, distance = np.zeros(len(points), np.int64), np.full(len(points), np.inf)

    def look(cell: int) -> None:
        rows, others = groups[cell], np.sort(np.concatenate([groups[one] for one in near[cell]]))
        candidates = points[others]
        for start in range(0, len(rows), TILE):
            part = rows[start : start + TILE]
            block = _distances(points[part], candidates, metric)
            block[np.arange(len(part)), np.searchsorted(others, part)] = np.inf
            at = block.argmin(axis=1)
            nearest[part], distance[part] = others[at], block[np.arange(len(part)), at]

    for _ in of_each(look, groups):
        pass
    return nearest, distance


def _distances(a: np.ndarray, b: np.ndarray, metric: Metric) -> np.ndarray:
    """(A, B) distances of prepared rows."""
    product = a @ b.T
    if metric == "cosine":
        return 1 - product
    square = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2 * product
    return np.sqrt(np.maximum(square, 0))
