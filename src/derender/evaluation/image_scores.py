"""Scores that are means over images, side by side: intervals, differences to the strongest control, tables.

All rows are scored on the same resamples of the images. Where lower is better a difference is the control's
score less the row's, so that above 0 is better everywhere. An image without a score (nothing of the object is
covered) is left out of its row's means; a single image has no interval.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, ClassVar, Literal

import numpy as np
from torch import Tensor

from derender.evaluation import bootstrap
from derender.evaluation.score_table import Column, ScoreTable, scored_table
from derender.storage.places import counted

LIGHT_BINS_DEG = (12.0, 25.0, 50.0, 77.0)  # edges of Yale B's subsets: the angle between light and view
TITLES = {  # of rows, by field of a result
    "model": "model", "average_depth": "average depth", "plane": "plane", "constant": "constant answer",
    "mean_picture": "mean image", "components": "PCA ({0.n_components})", "untrained": "untrained model",
}  # fmt: skip


class ImageResult:
    """A model's scores beside its controls, all on the same images.

    ``columns`` are of the scores, ``caption`` has a place for the number of images. ``coverage`` is the
    column of ``coverage`` where rows have that. ``TITLES`` name the rows by field, the model first, with a
    place for the result's numbers. ``notes`` are on rows, by their name.
    """

    columns: ClassVar[Mapping[str, Column]]
    caption: ClassVar[str]
    coverage: ClassVar[Column | None] = None
    notes: ClassVar[Mapping[str, str]] = {}

    def named(self) -> dict[str, Any]:
        """By row those that were scored: objects with (N,) of each score as ``SCORE_each``."""
        scored = {field: getattr(self, field, None) for field in TITLES}
        return {TITLES[field].format(self): scores for field, scores in scored.items() if scores is not None}

    def each(self) -> dict[str, dict[str, np.ndarray]]:
        """Every score of every image, (N,), by row."""
        return {
            row: {score: getattr(one, f"{score}_each") for score in self.columns}
            for row, one in self.named().items()
        }

    def rows(self, count: int = bootstrap.RESAMPLES, seed: int = 0) -> tuple[bootstrap.ScoredRow, ...]:
        """The model, then its controls, with intervals."""
        each = self.each()
        weights = bootstrap.once_and_resampled(len(next(iter(each["model"].values()))), count, seed)
        return image_rows(each, self.columns, weights)

    def table(self, rows: Sequence[bootstrap.ScoredRow] | None = None) -> ScoreTable:
        """The scores in the units of the columns; with ``rows``, their intervals too."""
        count = len(next(iter(self.each()["model"].values())))
        more = {} if self.coverage is None else {self.coverage: lambda row: self.named()[row.name].coverage}
        result = scored_table(
            self.caption.format(counted(count, "images")), "prediction", rows or self.rows(1), self.columns,
            intervals=() if rows is None else tuple(self.columns), deviations=(), more=more, over="images",
        )  # fmt: skip
        return replace(result, rows=[replace(row, note=self.notes.get(row.name, "")) for row in result.rows])


def means_and_each(**scores: Tensor) -> dict[str, Any]:
    """The mean of (N,) values of each score over the images that have one; all of them as ``SCORE_each``."""
    means = {name: values.nanmean().item() for name, values in scores.items()}
    return means | {f"{name}_each": values.numpy(force=True) for name, values in scores.items()}


def image_rows(
    scores: Mapping[str, Mapping[str, np.ndarray]], columns: Mapping[str, Column], weights: np.ndarray,
    controls: Collection[str] | None = None,
) -> tuple[bootstrap.ScoredRow, ...]:  # fmt: skip
    """A row for each name in ``scores``, which holds every score's (N,) values of the same images, NaN where
    there is none. ``weights`` are by ``once_and_resampled``, ``controls`` by default all rows but the first.
    """
    quiet = list(scores)[1:] if controls is None else controls
    rows = []
    for name, each in scores.items():
        result = {score: _estimate(values, weights) for score, values in each.items()}
        rows.append(bootstrap.ScoredRow(name, name in quiet, 1, result))
    lower = [name for name, column in columns.items() if column.best == "low"]
    return bootstrap.with_verdicts(rows, lower=lower)


def binned_rows(
    scores: Mapping[str, np.ndarray], angle: np.ndarray, weights: np.ndarray,
    controls: Collection[str] | None = None, *, best: Literal["high", "low"] = "high", digits: int = 3,
    bins: Sequence[float] = LIGHT_BINS_DEG,
) -> tuple[tuple[bootstrap.ScoredRow, ...], dict[str, Column], dict[str, int]]:  # fmt: skip
    """Rows of (N,) scores; columns for all and for groups by (N,) angles in degrees; images in each.

    ``bins`` are upper edges; larger angles are "beyond", NaN in no group. The rest is as of ``image_rows``.
    """
    inside = {"all": np.ones(len(angle), bool)}
    for low, high in pairwise((-1.0, *bins, np.inf)):
        inside["beyond" if high == np.inf else f"<= {high:g}"] = (angle > low) & (angle <= high)
    inside = {name: rows for name, rows in inside.items() if rows.any()}
    counts = {name: int(rows.sum()) for name, rows in inside.items()}
    columns = {name: Column(name, best, digits, counted(number, "images")) for name, number in counts.items()}
    each = {
        row: {name: np.where(rows, own, np.nan) for name, rows in inside.items()}
        for row, own in scores.items()
    }
    return image_rows(each, columns, weights, controls), columns, counts


def _estimate(values: np.ndarray, weights: np.ndarray) -> bootstrap.Estimate:
    known = ~np.isnan(values)
    mean = values[known].mean() if known.any() else np.nan
    means = np.full(len(weights) - 1, np.nan)
    if known.sum() > 1:  # else there is nothing to resample
        drawn = weights[1:, known]
        count = drawn.sum(axis=1)
        means = np.divide(drawn @ values[known], count, out=np.full(len(drawn), mean), where=count > 0)
    return bootstrap.estimate([mean], means)
