"""Nearest pictures by one factor: the same shape in any light, the same light on any shape.

Exact: every row is compared, in blocks, with one matrix product each, in float64. Distances: cosine is
1 - cosine, 0..2 (a row of zeros is at distance 1 from all); euclidean is not squared. Equally near rows come
in the table's order. Leaves out approximate indices, which pay from some ten million rows on.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from derender.data import suggestion
from derender.features.table import FeatureTable, named
from derender.postprocess.fitting import PARAMETERS

METRICS = ("cosine", "euclidean")
BLOCK_ROWS = 4096
NUMBERS_AT_ONCE = 1 << 23
"""So many distances are held at a time (64 MB)."""
SAME_PICTURE = 1e-3
"""Largest relative difference, in every factor, of one picture embedded twice (batches and devices round)."""
SAME_FITTED = 0.3
"""The same of fitted scenes: sixty steps turn what is rounded into 0.12 (measured); others are 0.6 away."""


@dataclass(frozen=True)
class Neighbours:
    """The nearest rows of Q queries, nearest first.

    Attributes:
        rows: (Q, k) rows of the table.
        distances: (Q, k) in the metric.
    """

    rows: Int64[np.ndarray, "q k"]
    distances: Float64[np.ndarray, "q k"]


def nearest(
    table: FeatureTable,
    query: np.ndarray,
    factor: str,
    k: int = 12,
    *,
    metric: str = "cosine",
    exclude: Sequence[int] = (),
) -> Neighbours:
    """The ``k`` rows of a table nearest to each query by one factor.

    Args:
        table: what is searched.
        query: (D,) or (Q, D) features of that factor.
        factor: name of the factor.
        k: how many; all rows if there are fewer.
        metric: cosine or euclidean.
        exclude: rows that are never found, such as the query's own.

    Raises:
        ValueError: the factor or metric is unknown, or the query does not fit.
    """
    rows = named(table.factors, factor, "factor")
    query = np.atleast_2d(np.asarray(query, dtype=np.float64))
    if metric not in METRICS:
        raise ValueError(
            f"unknown metric {metric!r}{suggestion(metric, METRICS)}; there is {', '.join(METRICS)}"
        )
    if query.ndim != 2 or query.shape[1] != rows.shape[1]:
        raise ValueError(
            f"{factor} has {rows.shape[1]} numbers in this table, the query {query.shape[-1]}: "
            "it was made by another model"
        )
    if not np.isfinite(query).all():
        raise ValueError("the query is not finite: check the picture and the model that embedded it")
    if k < 1:
        raise ValueError(f"k must be 1 or more, got {k}")
    hidden = np.unique(np.asarray(exclude, dtype=np.int64))
    count = min(k, len(rows) - len(hidden))
    if count < 1:
        raise ValueError(f"there is no row to find: the table has {len(rows)}, {len(hidden)} are left out")
    found = np.empty((len(query), count), np.int64)
    distances = np.empty((len(query), count), np.float64)
    at_once = max(1, NUMBERS_AT_ONCE // len(rows))
    for start in range(0, len(query), at_once):
        part = slice(start, start + at_once)
        block = _distances(query[part], rows, metric)
        block[:, hidden] = np.inf
        for number, row in enumerate(block, start):
            found[number] = _smallest(row, count)
            distances[number] = row[found[number]]
    return Neighbours(found, distances)


def same_picture(table: FeatureTable, codes: Mapping[str, np.ndarray]) -> Int64[np.ndarray, " m"]:
    """Rows that are a picture itself, or copies of it under other names: alike in every factor they share.

    Args:
        table: what is searched.
        codes: (D,) features of the picture by factor; factors that the table lacks are passed over.

    Returns:
        rows in the table's order, none where picture and table share no factor.
    """
    shared = [name for name in codes if name in table.factors]
    rows = np.arange(len(table) if shared else 0)
    fitted = PARAMETERS if table.origin.get("fit_steps") else ()
    for name in shared:
        limit = SAME_FITTED if name in fitted else SAME_PICTURE
        query = np.asarray(codes[name], dtype=np.float64)
        near = np.empty(len(rows), bool)
        for start in range(0, len(rows), BLOCK_ROWS):
            part = slice(start, start + BLOCK_ROWS)
            away = np.linalg.norm(table.factors[name][rows[part]] - query, axis=1)
            near[part] = away <= limit * np.linalg.norm(query)
        rows = rows[near]
    return rows.astype(np.int64)


def _distances(query: np.ndarray, rows: np.ndarray, metric: str) -> np.ndarray:
    """(Q, N) distances."""
    result = np.empty((len(query), len(rows)))
    middle = query.mean(axis=0)  # close to the query, so that squares do not cancel
    lengths = np.linalg.norm(query, axis=1)
    for start in range(0, len(rows), BLOCK_ROWS):
        part = slice(start, start + BLOCK_ROWS)
        block = rows[part].astype(np.float64)
        if metric == "euclidean":
            block -= middle
            shifted = query - middle
            square = np.einsum("nd,nd->n", block, block) + np.einsum("qd,qd->q", shifted, shifted)[:, None]
            result[:, part] = np.sqrt(np.maximum(square - 2 * shifted @ block.T, 0))
        else:
            scale = lengths[:, None] * np.sqrt(np.einsum("nd,nd->n", block, block))
            product = query @ block.T
            cosine = np.divide(product, scale, out=np.zeros_like(product), where=scale > 0)
            result[:, part] = 1 - cosine.clip(-1, 1)
    return result


def _smallest(values: np.ndarray, count: int) -> np.ndarray:
    """Places of the ``count`` smallest values in rising order; of equal ones the first."""
    limit = np.partition(values, count - 1)[count - 1]
    places = np.flatnonzero(values <= limit)
    return places[np.argsort(values[places], kind="stable")][:count]
