"""Nearest images by one factor: the same shape under any lighting, the same lighting on any shape.

Exact: every row is compared, in blocks, with one matrix product each, in float64. Distances: cosine is
1 - cosine, 0..2 (a row of zeros is at distance 1 from all); euclidean is not squared. Equally near rows come
in the table's order. Leaves out approximate indices, which pay from some ten million rows on.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from derender.data import nearest_sibling, read_image, suggestion
from derender.features.extract import embed_images, model_fingerprint
from derender.features.table import FeatureTable, named
from derender.inputs import as_model
from derender.postprocess.fitting import PARAMETERS

METRICS = ("cosine", "euclidean")
BLOCK_ROWS = 4096
NUMBERS_AT_ONCE = 1 << 23
"""So many distances are held at a time (64 MB)."""
SAME_PICTURE = 1e-3
"""Largest relative difference, in every factor, of one image embedded twice (batches and devices round)."""
SAME_FITTED = 0.3
"""The same of scenes optimised per image: after sixty steps 0.12 (measured); others are 0.6 away."""


@dataclass(frozen=True)
class Neighbours:
    """The nearest rows of Q queries, nearest first.

    Attributes:
        rows: (Q, k) rows of the table.
        distances: (Q, k) in the metric.
    """

    rows: Int64[np.ndarray, "q k"]
    distances: Float64[np.ndarray, "q k"]


@dataclass(frozen=True)
class Found:
    """The rows of a table nearest to one image by one factor, nearest first.

    Attributes:
        table: what was searched.
        like: the image, or the file name of its row.
        factor, metric: how rows were compared.
        rows: (k,) rows of the table.
        distances: (k,) in the metric.
        own_row: the row that ``like`` names, if it names one.
        same_image: rows with the very same image, which are left out unless copies are asked for.
        unchecked: whether the table does not record which model made it.
    """

    table: FeatureTable
    like: str
    factor: str
    metric: str
    rows: Sequence[int]
    distances: Sequence[float]
    own_row: int | None
    same_image: Sequence[int]
    unchecked: bool = False

    @property
    def files(self) -> tuple[str, ...]:
        """Names of the rows."""
        return tuple(self.table.files[row] for row in self.rows)

    def labels(self, row: int) -> dict[str, Any]:
        """The labels of a row of the table."""
        return {name: values[row] for name, values in self.table.labels.items()}


def search(
    table: FeatureTable | str | Path,
    like: str | Path,
    factor: str = "geometry",
    k: int = 12,
    *,
    metric: str = "cosine",
    model: Any = None,
    copies: bool = False,
    device: str = "auto",
) -> Found:
    """The images of a table that are nearest to one image by one factor.

    Args:
        table: a feature table or its parquet file.
        like: a file name of the table's rows, or with ``model`` an image file.
        factor: which factor has to be alike.
        k: how many rows; all if there are fewer.
        metric: cosine or euclidean.
        model: the model that made the table, for an image that is not in it.
        copies: find the image itself too, and copies of it.
        device: for a model that is loaded here.

    Raises:
        ValueError: no such row, factor or metric, or the table was made by another model.
        FileNotFoundError: no such image.
    """
    name = str(table) if isinstance(table, str | Path) else "the table"
    rows = table if isinstance(table, FeatureTable) else FeatureTable.read(table, only=factor)
    own_row, unchecked = rows.files.index(str(like)) if str(like) in rows.files else None, False
    if own_row is not None and (model is None or not Path(like).is_file()):
        codes: dict[str, np.ndarray] = {key: values[own_row] for key, values in rows.factors.items()}
    elif model is None:
        known = rows.files if len(rows) <= 2_000 else ()
        hint = (
            "; to search with an image, add a model" if Path(like).is_file() else suggestion(str(like), known)
        )
        raise ValueError(f"{name} has no row {str(like)!r}{hint}; its first is {rows.files[0]!r}")
    else:
        if not Path(like).is_file():
            raise FileNotFoundError(f"{like} is no image file{nearest_sibling(Path(like))}")
        net, own_row = maker_of(rows, model, name, device=device), None
        unchecked = rows.origin.get("weights") is None
        image = read_image(Path(like), net.image_size)
        codes = {key: values[0] for key, values in embed_images(net, image[None]).items()}
        if factor not in codes:
            raise ValueError(f"{model} makes no {factor!r}; it makes {', '.join(codes)}")
    itself = same_picture(rows, codes).tolist()
    hidden = [] if copies else itself
    if len(hidden) == len(rows):
        raise ValueError(f"{name} has no row but {like} itself: include copies to find that")
    near = nearest(rows, codes[factor], factor, k, metric=metric, exclude=hidden)
    return Found(
        rows, str(like), factor, metric, near.rows[0].tolist(), near.distances[0].tolist(), own_row, itself,
        unchecked,
    )  # fmt: skip


def maker_of(table: FeatureTable, model: Any, name: str = "the table", *, device: str = "auto") -> Any:
    """The model that made a table, with as many steps of test-time optimisation; another one is an error."""
    net, steps = as_model(model, device=device), table.origin.get("fit_steps")
    source = model if isinstance(model, str | Path) else net.source or "this model"
    if net.fitting is not None and isinstance(steps, int):
        net = as_model(net, fit_steps=max(0, steps))
    made_by, weights = table.origin.get("weights"), model_fingerprint(net)
    if made_by not in (None, weights):
        raise ValueError(
            f"{name} was made by another model (weights {made_by}, {source} has {weights}): "
            "give that one, or make the table again with derender embed"
        )
    return net


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
        table: the rows to search.
        query: (D,) or (Q, D) features of that factor.
        factor: name of the factor.
        k: how many; all rows if there are fewer.
        metric: cosine or euclidean.
        exclude: rows to leave out, such as the query's own.

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
        raise ValueError("the query is not finite: check the image and the model that embedded it")
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
    """Rows of an image itself, or copies of it under other names: alike in every factor they share.

    Args:
        table: the rows to search.
        codes: (D,) features of the image by factor; factors that the table lacks are passed over.

    Returns:
        rows in the table's order, none where image and table share no factor.
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
    """Places of the ``count`` smallest values in rising order; of equal values the first."""
    limit = np.partition(values, count - 1)[count - 1]
    places = np.flatnonzero(values <= limit)
    return places[np.argsort(values[places], kind="stable")][:count]
