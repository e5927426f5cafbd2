"""Each row's nearest other row by cosine, in bounded memory: exactly, or by cells for very many rows.

Distances are made in blocks with one matrix product each, in a copy of the rows and 64 MB. Equally near rows:
the first counts. Above ``EXACT_ROWS`` rows a row is compared with those of its own cell and of the
``NEAR_CELLS`` nearest ones, in float32: work grows with the rows and not with their square.

``cells`` puts near rows together. Centres come from a few rounds of k-means (Lloyd 1982) over a sample; every
row goes to its nearest centre. Cells that came out too large are divided again. Rows on two sides of a border
do not see each other.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np
from jaxtyping import Float32, Int64
from threadpoolctl import threadpool_limits

from derender.data import usable_cores

T = TypeVar("T")
NUMBERS_AT_ONCE = 1 << 23
EXACT_ROWS = 100_000  # up to so many rows all pairs are looked at
NEAR_CELLS = 4
CELL_ROWS = 2_000  # rows that a cell is to have; none has more than four times as many


def finite_rows(features: np.ndarray, purpose: str) -> np.ndarray:
    """(N, D) features as float64 (float32 above ``EXACT_ROWS`` rows), or an error that says what is wrong."""
    features = np.asarray(features)
    features = features.astype(np.float32 if len(features) > EXACT_ROWS else np.float64, copy=False)
    if features.ndim != 2:
        raise ValueError(f"features must be (rows, dimensions), got shape {features.shape}")
    if not np.isfinite(features).all():
        bad = f"{int((~np.isfinite(features).all(axis=1)).sum())} of {len(features)} rows"
        raise ValueError(f"features are not finite in {bad}: drop these rows or check the model")
    if len(features) < 2:
        raise ValueError(f"{purpose} takes 2 rows or more, got {len(features)}")
    return features


def unit_rows(points: np.ndarray) -> np.ndarray:
    """Rows of length 1; a zero row stays, at cosine distance 1 from all."""
    length = np.linalg.norm(points, axis=1, keepdims=True)
    return np.divide(points, length, out=np.zeros_like(points), where=length > 0)


def nearest_rows(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each of (N, D) rows the nearest other row, (N,) integers, and its cosine distance, (N,), 0..2.

    Above ``EXACT_ROWS`` rows some are not the nearest: docs/how-to/scale.md says how many.
    """
    points = unit_rows(points)
    nearest, distance = np.zeros(len(points), np.int64), np.full(len(points), np.inf)

    def look(rows: np.ndarray, others: np.ndarray) -> None:
        """Find the nearest of some others, in ascending order, the rows themselves among them."""
        candidates = points if len(others) == len(points) else points[others]
        at_once = max(1, NUMBERS_AT_ONCE // len(others))
        for part in np.split(rows, range(at_once, len(rows), at_once)):
            block = 1 - points[part] @ candidates.T
            block[np.arange(len(part)), np.searchsorted(others, part)] = np.inf
            distance[part], nearest[part] = block.min(axis=1), others[block.argmin(axis=1)]

    if len(points) <= EXACT_ROWS:
        look(np.arange(len(points)), np.arange(len(points)))
        return nearest, distance
    points = points.astype(np.float32, copy=False)
    groups = cells(points, CELL_ROWS)
    centres = np.stack([points[rows].mean(axis=0) for rows in groups])
    square = (centres**2).sum(axis=1)
    apart = square[:, None] + square - 2 * centres @ centres.T
    np.fill_diagonal(apart, -np.inf)  # its own cell comes first
    near = np.argsort(apart, axis=1, kind="stable")[:, : NEAR_CELLS + 1]

    def look_around(cell: int) -> None:
        look(groups[cell], np.sort(np.concatenate([groups[one] for one in near[cell]])))

    of_each(look_around, groups)
    return nearest, distance


def cells(points: Float32[np.ndarray, "n d"], rows_per_cell: int) -> list[Int64[np.ndarray, " rows"]]:
    """The rows of each cell, in ascending order; near rows mostly share a cell."""
    groups, waiting = [], [np.arange(len(points))]
    generator = np.random.default_rng(0)
    while waiting:
        rows = waiting.pop()
        if len(rows) <= rows_per_cell:
            groups.append(rows)
            continue
        wanted = -(-len(rows) // rows_per_cell)
        sampled = generator.choice(rows, min(len(rows), 32 * wanted), replace=False)
        result = _nearest_centre(points, rows, _centres(points[np.sort(sampled)], wanted, generator))
        parts = [rows[result == one] for one in np.unique(result)]
        if len(parts) == 1:  # copies of one row: no centre tells them apart
            parts = np.array_split(rows, wanted)
        for part in parts:
            (waiting if len(part) > 4 * rows_per_cell else groups).append(part)
    return groups


def of_each(work: Callable[[int], T], groups: Sequence[np.ndarray]) -> list[T]:
    """What ``work`` gives for the number of each cell, in order, computed on all cores, one cell on each."""
    with threadpool_limits(1), ThreadPoolExecutor(usable_cores(), thread_name_prefix="cell") as pool:
        return list(pool.map(work, range(len(groups))))


def _centres(sample: np.ndarray, wanted: int, generator: np.random.Generator) -> np.ndarray:
    centres = sample[generator.choice(len(sample), wanted, replace=False)].copy()
    for _ in range(6):
        result = _nearest_centre(sample, np.arange(len(sample)), centres)
        order = np.argsort(result, kind="stable")
        held, first = np.unique(result[order], return_index=True)
        sums = np.add.reduceat(sample[order], first, axis=0)
        centres[held] = sums / np.diff([*first, len(sample)])[:, None]
    return centres


def _nearest_centre(points: np.ndarray, rows: np.ndarray, centres: np.ndarray) -> np.ndarray:
    half_square = (centres**2).sum(axis=1) / 2
    parts = np.split(rows, range(2_048, len(rows), 2_048))
    return np.concatenate([(half_square - points[part] @ centres.T).argmin(axis=1) for part in parts])
