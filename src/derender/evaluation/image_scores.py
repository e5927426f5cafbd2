"""Scores that are means over images, side by side: intervals, differences to the strongest control, tables.

All rows are scored on the same resamples of the images. Where lower is better a difference is the control's
score less the row's, so that above 0 is better everywhere. An image without a score (nothing of the object is
covered) is left out of its row's means; a single image has no interval.
"""

from collections.abc import Mapping, Sequence
from math import isfinite

import numpy as np

from derender.evaluation.bootstrap import (
    RESAMPLES,
    Estimate,
    ScoredRow,
    estimate,
    resamples,
    with_verdicts,
)
from derender.evaluation.score_table import Cell, Column, Row, ScoreTable, interval_column, interval_of

Columns = Mapping[str, tuple[Column, float]]
"""By score, its column and the factor from the score to the unit of the column."""


def image_rows(
    scores: Mapping[str, Mapping[str, np.ndarray]],
    columns: Columns,
    *,
    resample_count: int = RESAMPLES,
    seed: int = 0,
) -> tuple[ScoredRow, ...]:
    """A row for each name, in their order; all but the first are controls.

    Args:
        scores: by row, every score's (N,) values of the images, NaN where there is none.
        columns: of the scores; they hold which end is better.
        resample_count: bootstrap resamples of the images.
        seed: of the resamples.

    Raises:
        ValueError: rows of different length.
    """
    lengths = {len(values) for each in scores.values() for values in each.values()}
    if len(lengths) != 1:
        raise ValueError(f"all rows must be scores of the same images, got {sorted(lengths)} of them")
    weights = np.concatenate(list(resamples(lengths.pop(), resample_count, seed)))
    rows = [
        ScoredRow(name, at > 0, 1, {score: _estimate(values, weights) for score, values in each.items()})
        for at, (name, each) in enumerate(scores.items())
    ]
    return with_verdicts(
        rows, lower=[score for score, (column, _) in columns.items() if column.best == "low"]
    )


def image_table(
    caption: str,
    rows: Sequence[ScoredRow],
    columns: Columns,
    *,
    intervals: bool = True,
    more: Mapping[Column, Mapping[str, float]] | None = None,
    notes: Mapping[str, str] | None = None,
) -> ScoreTable:
    """The rows in the units of the columns.

    Args:
        caption: of the table.
        rows: of ``image_rows``.
        columns: in the order of display.
        intervals: whether a column of 95 % intervals follows each score.
        more: further columns, by name of the row.
        notes: on rows, by their name.
    """
    heads: list[Column] = []
    for column, _ in columns.values():
        heads += [column, interval_column(column, "images")] if intervals else [column]

    def cells(row: ScoredRow) -> list[Cell]:
        found: list[Cell] = []
        for score, (_, scale) in columns.items():
            found.append(scale * row.scores[score].value)
            found += [interval_of(row, score, scale)] if intervals else []
        return [*found, *(values.get(row.name) for values in (more or {}).values())]

    made = [Row(row.name, cells(row), row.control, (notes or {}).get(row.name, "")) for row in rows]
    return ScoreTable(caption, "prediction", [*heads, *(more or {})], made)


def image_verdicts(row: ScoredRow, columns: Columns) -> list[str]:
    """In words, for every score: the row against the strongest control."""
    found = []
    for score, (column, scale) in columns.items():
        one = row.versus.get(score)
        if one is None or not isfinite(one.low):
            continue
        how = "better than" if one.above else "worse than" if one.high < 0 else "not distinguished from"
        ends = [f"{scale * value:+.{column.digits}f}" for value in (one.value, one.low, one.high)]
        found.append(
            f"{column.name}: {column.text(scale * row.scores[score].value)}, {how} the strongest "
            f"control ({one.rival}), by {ends[0]}, 95 % {ends[1]} to {ends[2]}"
        )
    return found


def _estimate(values: np.ndarray, weights: np.ndarray) -> Estimate:
    values = np.asarray(values, np.float64)
    known = ~np.isnan(values)
    if known.sum() < 2:  # nothing to resample
        value = float(values[known].mean()) if known.any() else float("nan")
        return estimate([value], np.full(len(weights), np.nan))
    mean, count = float(values[known].mean()), weights[:, known].sum(axis=1)
    total = weights[:, known] @ values[known]
    return estimate([mean], np.divide(total, count, out=np.full(len(weights), mean), where=count > 0))
