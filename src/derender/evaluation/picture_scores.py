"""Scores that are means over pictures, side by side: intervals, and differences to the strongest control.

All rows are scored on the same resamples of the pictures. Where lower is better a difference is the control's
score less ours, so that above 0 is better everywhere. A picture that a row has no score for (nothing of the
object is covered) is left out of that row's means; of a single picture there is no interval.
"""

from collections.abc import Collection, Mapping

import numpy as np

from derender.evaluation.bootstrap import (
    RESAMPLES,
    Estimate,
    ScoredRow,
    estimate,
    resamples,
    with_verdicts,
)

Each = Mapping[str, np.ndarray]


def picture_rows(
    scores: Mapping[str, Each],
    controls: Collection[str],
    *,
    lower: Collection[str] = (),
    resample_count: int = RESAMPLES,
    seed: int = 0,
) -> tuple[ScoredRow, ...]:
    """A row for each name, in their order.

    Args:
        scores: by row, every score's (N,) values of the pictures, NaN where there is none.
        controls: names of the rows that learned nothing.
        lower: scores whose best end is the low one.
        resample_count: bootstrap resamples of the pictures.
        seed: of the resamples.

    Raises:
        ValueError: rows of different length.
    """
    lengths = {len(values) for each in scores.values() for values in each.values()}
    if len(lengths) != 1:
        raise ValueError(f"all rows must be scores of the same pictures, got {sorted(lengths)} of them")
    weights = np.concatenate(list(resamples(lengths.pop(), resample_count, seed)))
    rows = [
        ScoredRow(
            name,
            name in controls,
            1,
            {score: _estimate(values, weights) for score, values in each.items()},
        )
        for name, each in scores.items()
    ]
    return with_verdicts(rows, lower=lower)


def _estimate(values: np.ndarray, weights: np.ndarray) -> Estimate:
    values = np.asarray(values, np.float64)
    known = ~np.isnan(values)
    if known.sum() < 2:  # nothing to resample
        value = float(values[known].mean()) if known.any() else float("nan")
        return estimate([value], np.full(len(weights), np.nan))
    count = weights[:, known].sum(axis=1)
    total = weights[:, known] @ values[known]
    drawn = np.divide(total, count, out=np.full(len(weights), values[known].mean()), where=count > 0)
    return estimate([float(values[known].mean())], drawn)
