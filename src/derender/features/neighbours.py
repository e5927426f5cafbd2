"""Nearest images by one factor: the same shape under any lighting, the same lighting on any shape.

Exact: every row is compared, in blocks, in float64. Distances: cosine is 1 - cosine, 0..2 (a row of zeros is
at distance 1 from all); euclidean is not squared. Equally near rows come in the table's order. Leaves out
approximate indices, which pay from some ten million rows on.
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
from derender.storage.places import require_known

METRICS = ("cosine", "euclidean")
BLOCK_ROWS = 4096
SAME_IMAGE = 1e-3  # largest relative difference, in every factor, of one image embedded twice (rounding)
SAME_FITTED = 0.3  # the same of fitted scenes: after twenty steps 0.14 (measured); others are 0.6 away


@dataclass(frozen=True)
class Found:
    """The rows of a table nearest to an image (or the row of that name) by one factor, nearest first.

    ``own_row`` is the row that ``like`` names, if any. ``same_image`` rows hold the very same image.
    ``unchecked`` tables do not record which model made them.
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
    table: FeatureTable | str | Path, like: str | Path, factor: str = "geometry", k: int = 12, *,
    metric: str = "cosine", model: Any = None, copies: bool = False, device: str = "auto",
) -> Found:  # fmt: skip
    """The images of a table that are nearest to one image by one factor.

    Args:
        table: a feature table or its parquet file.
        like: a file name of the table's rows, or with ``model`` an image file.
        factor: which factor has to be alike.
        k, metric: how many rows, all if there are fewer; cosine or euclidean.
        model: the model that made the table, for an image that is not in it.
        copies: find the image itself too, and copies of it.
        device: for a model that is loaded here.

    Raises:
        ValueError: no such row, factor or metric, or the table was made by another model.
        FileNotFoundError: no such image.
    """
    name, like = str(table) if isinstance(table, str | Path) else "the table", str(like)
    rows = table if isinstance(table, FeatureTable) else FeatureTable.read(table, only=factor)
    own_row, is_file = rows.files.index(like) if like in rows.files else None, Path(like).is_file()
    if own_row is not None and (model is None or not is_file):
        codes: dict[str, np.ndarray] = {key: values[own_row] for key, values in rows.factors.items()}
        unchecked = False
    elif model is None:
        hint = "; to search with an image, add a model"
        if not is_file:
            hint = suggestion(like, rows.files if len(rows) <= 2_000 else ())
        raise ValueError(f"{name} has no row {like!r}{hint}; its first is {rows.files[0]!r}")
    elif not is_file:
        raise FileNotFoundError(f"{like} is no image file{nearest_sibling(Path(like))}")
    else:
        net, own_row = maker_of(rows, model, name, device=device), None
        unchecked = rows.origin.get("weights") is None
        image = read_image(Path(like), net.image_size)
        codes = {key: values[0] for key, values in embed_images(net, image[None]).items()}
        named(codes, factor, f"factor of {model}")
    itself = same_image(rows, codes).tolist()
    hidden = [] if copies else itself
    if len(hidden) == len(rows):
        raise ValueError(f"{name} has no row but {like} itself: include copies to find that")
    near, away = nearest(rows, codes[factor], factor, k, metric=metric, exclude=hidden)
    return Found(rows, like, factor, metric, near.tolist(), away.tolist(), own_row, itself, unchecked)


def maker_of(table: FeatureTable, model: Any, name: str = "the table", *, device: str = "auto") -> Any:
    """The model that made a table, with as many steps of test-time optimisation; another one is an error."""
    net, steps = as_model(model, device=device), table.origin.get("fit_steps")
    source = model if isinstance(model, str | Path) else net.source or "this model"
    if net.fitting is not None and isinstance(steps, int):
        net = as_model(net, fit_steps=max(0, steps))
    made_by, weights = table.origin.get("weights"), model_fingerprint(net)
    if made_by not in (None, weights):
        fix = "give that one, or make the table again with derender embed"
        differ = f"weights {made_by}, {source} has {weights}"
        raise ValueError(f"{name} was made by another model ({differ}): {fix}")
    return net


def nearest(
    table: FeatureTable, query: np.ndarray, factor: str, k: int = 12, *, metric: str = "cosine",
    exclude: Sequence[int] = (),
) -> tuple[Int64[np.ndarray, " k"], Float64[np.ndarray, " k"]]:  # fmt: skip
    """The ``k`` rows of a table nearest to a (D,) query by one factor, nearest first, and their distances.

    Rows in ``exclude`` are left out. ValueError: unknown factor or metric, or the query does not fit.
    """
    rows = named(table.factors, factor, "factor")
    require_known("metric", metric, METRICS)
    if len(query) != rows.shape[1]:
        sizes = f"{rows.shape[1]} numbers in this table, the query {len(query)}"
        raise ValueError(f"{factor} has {sizes}: it was made by another model")
    if not np.isfinite(query).all():
        raise ValueError("the query is not finite: check the image and the model that embedded it")
    if k < 1:
        raise ValueError(f"k must be 1 or more, got {k}")
    hidden = np.unique(np.asarray(exclude, dtype=np.int64))
    count = min(k, len(rows) - len(hidden))
    if count < 1:
        raise ValueError(f"there is no row to find: the table has {len(rows)}, {len(hidden)} are left out")
    away = _distances(query, rows, metric)
    away[hidden] = np.inf
    places = np.flatnonzero(away <= np.partition(away, count - 1)[count - 1])
    result = places[np.argsort(away[places], kind="stable")][:count]
    return result, away[result]


def same_image(table: FeatureTable, codes: Mapping[str, np.ndarray]) -> Int64[np.ndarray, " m"]:
    """Rows of an image itself, or copies of it under other names: alike in every factor they share.

    ``codes`` are (D,) features of the image by factor; factors that the table lacks are passed over.
    """
    shared = [name for name in codes if name in table.factors]
    fitted = PARAMETERS if table.origin.get("fit_steps") else ()
    rows: Any = slice(len(table) if shared else 0)
    for name in shared:
        away = _distances(codes[name], table.factors[name][rows], "euclidean")
        limit = SAME_FITTED if name in fitted else SAME_IMAGE
        rows = np.arange(len(table))[rows][away <= limit * np.linalg.norm(codes[name].astype(np.float64))]
    return np.arange(len(table))[rows]


def _distances(query: np.ndarray, rows: np.ndarray, metric: Any) -> Float64[np.ndarray, " n"]:
    """From one feature (D,) to each of (N, D) rows."""
    from scipy.spatial.distance import cdist

    blocks = (rows[start : start + BLOCK_ROWS] for start in range(0, len(rows), BLOCK_ROWS))
    away = np.concatenate([np.empty(0), *(cdist(query[None], block, metric)[0] for block in blocks)])
    return np.nan_to_num(away.clip(0), nan=1.0)  # the cosine of zeros
