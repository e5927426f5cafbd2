"""Very many rows in small cells of near ones, so that work grows with the rows and not with their square.

Centres come from a few rounds of k-means (Lloyd 1982) over a sample; every row goes to its nearest centre;
cells that came out too large are divided again. Approximate by nature: rows on two sides of a border do not
see each other. All of it is float32, and nothing is random but for the seed.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np
from jaxtyping import Float32, Int64
from threadpoolctl import threadpool_limits

from derender.data import usable_cores

T = TypeVar("T")

CELL_ROWS = 2_000
"""Rows that a cell is to have; none has more than four times as many."""

_SAMPLED_PER_CELL = 32
_ROUNDS = 6
_TILE = 2_048


def cells(
    points: Float32[np.ndarray, "n d"], rows_per_cell: int = CELL_ROWS, seed: int = 0
) -> Int64[np.ndarray, " n"]:
    """The cell of each row, (N,) integers from 0 without gaps; near rows mostly share one."""
    number = np.zeros(len(points), np.int64)
    waiting, made = [np.arange(len(points))], 0
    generator = np.random.default_rng(seed)
    while waiting:
        rows = waiting.pop()
        if len(rows) <= rows_per_cell:
            number[rows], made = made, made + 1
            continue
        wanted = -(-len(rows) // rows_per_cell)
        sampled = generator.choice(rows, min(len(rows), _SAMPLED_PER_CELL * wanted), replace=False)
        found = _nearest_centre(points, rows, _centres(points[np.sort(sampled)], wanted, generator))
        parts = [rows[found == one] for one in np.unique(found)]
        if len(parts) == 1:  # copies of one row: no centre tells them apart
            parts = np.array_split(rows, wanted)
        for part in parts:
            if len(part) > 4 * rows_per_cell:
                waiting.append(part)
            else:
                number[part], made = made, made + 1
    return number


def members(number: Int64[np.ndarray, " n"]) -> list[Int64[np.ndarray, " rows"]]:
    """The rows of each cell, in ascending order."""
    order = np.argsort(number, kind="stable")
    return np.split(order, np.cumsum(np.bincount(number))[:-1])


def of_each(work: Callable[[int], T], groups: Sequence[np.ndarray]) -> Iterator[T]:
    """What ``work`` gives for the number of each cell, in order, computed on all cores, one cell on each."""
    with threadpool_limits(1), ThreadPoolExecutor(usable_cores(), thread_name_prefix="cell") as pool:
        yield from pool.map(work, range(len(groups)))


def _centres(sample: np.ndarray, wanted: int, generator: np.random.Generator) -> np.ndarray:
    centres = sample[generator.choice(len(sample), wanted, replace=False)].copy()
    for _ in range(_ROUNDS):
        found = _nearest_centre(sample, np.arange(len(sample)), centres)
        order = np.argsort(found, kind="stable")
        held, first = np.unique(found[order], return_index=True)
        sums = np.add.reduceat(sample[order], first, axis=0)
        centres[held] = sums / np.diff([*first, len(sample)])[:, None]
    return centres


def _nearest_centre(points: np.ndarray, rows: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """For each of these rows the nearest centre."""
    found, half_square = np.empty(len(rows), np.int64), (centres**2).sum(axis=1) / 2
    for start in range(0, len(rows), _TILE):
        part = slice(start, start + _TILE)
        found[part] = (half_square - points[rows[part]] @ centres.T).argmin(axis=1)
    return found
