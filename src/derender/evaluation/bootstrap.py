"""How sure a score is: resamples of the rows, intervals, and differences to the strongest control.

Source: Efron's percentile bootstrap. Rows are drawn with replacement. Fitted clusters and heads stay as they
are: an interval covers the choice of scored images and no other training. All features of a table are scored
on the same resamples, which makes their differences paired. Leaves out corrections for many comparisons: of
twenty rows that are no better than a control, half a one is called better by chance.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

RESAMPLES = 1_000
LEVEL = 0.95
CHUNK_BYTES = 64 << 20
Runs = Sequence[float] | np.ndarray  # a score of each run


@dataclass(frozen=True)
class Estimate:
    """A score, the mean over runs, with its 95 % interval (NaN where there is none).

    ``deviation`` is the standard deviation over runs (seeds), NaN for one; ``resampled`` the (B,) resamples.
    """

    value: float
    low: float
    high: float
    deviation: float
    resampled: np.ndarray = field(repr=False)


@dataclass(frozen=True)
class Difference:
    """A score less that of the strongest control, ``rival``, on the same resamples, with its 95 % interval.

    Above 0 is better, whichever end is; ``above`` tells whether the whole interval lies there.
    """

    rival: str
    value: float
    low: float
    high: float
    above: bool


@dataclass(frozen=True)
class ScoredRow:
    """Scores of one kind of feature by name, over ``runs`` seeds. Features other than controls, which learned
    nothing, have their differences to the strongest control."""

    name: str
    control: bool
    runs: int
    scores: Mapping[str, Estimate]
    versus: Mapping[str, Difference] = field(default_factory=dict)


def numbers_of(rows: Iterable[ScoredRow]) -> dict[str, dict[str, Any]]:
    """Everything but the resamples by the names of the rows, as JSON takes it."""
    result = {}
    for row in rows:
        scores = {
            name: {"value": one.value, "low": one.low, "high": one.high, "spread": one.deviation}
            for name, one in row.scores.items()
        }
        result[row.name] = {"control": row.control, "runs": row.runs, "scores": scores, "versus": row.versus}
    return result


def resamples(n_rows: int, count: int = RESAMPLES, seed: int = 0) -> Iterator[np.ndarray]:
    """How often each row is drawn, in portions of (b, N) float32 that together hold ``count`` resamples."""
    if n_rows < 1 or count < 1:
        raise ValueError(f"resampling needs a row and a resample, got {n_rows} rows and {count} resamples")
    generator = np.random.default_rng(seed)
    portion = max(1, CHUNK_BYTES // (8 * n_rows))
    for start in range(0, count, portion):
        size = min(portion, count - start)
        drawn = generator.integers(n_rows, size=(size, n_rows)) + n_rows * np.arange(size)[:, None]
        yield np.bincount(drawn.ravel(), minlength=size * n_rows).reshape(size, n_rows).astype(np.float32)


def once_and_resampled(groups: np.ndarray | int, count: int = RESAMPLES, seed: int = 0) -> np.ndarray:
    """First every row once, then ``count`` resamples: how often each is drawn, (1 + count, N) float32.

    Rows of one of the (N,) ``groups`` are drawn together; a number of rows has no groups.
    """
    if isinstance(groups, int):
        units, unit_of = groups, slice(None)
    else:
        names, unit_of = np.unique(groups, return_inverse=True)
        units = len(names)
    drawn = [np.ones((1, units), np.float32), *resamples(units, count, seed)]
    return np.concatenate(drawn)[:, unit_of]


def estimate(runs: Runs, resampled: np.ndarray, *, centred: bool = False, most: float = np.inf) -> Estimate:
    """The mean over ``runs`` with its percentile interval, from (B,) means over runs on each resample.

    ``centred`` moves the resamples so that their mean is the value, and none exceeds ``most``. Scores of
    clusters need it: duplicated rows inflate purity.
    """
    value, deviation = float(np.mean(runs)), float(np.std(runs, ddof=1)) if len(runs) > 1 else np.nan
    if centred:
        resampled = np.minimum(resampled - resampled.mean() + value, most)
    return Estimate(value, *_interval(resampled), deviation, resampled)


def constant(runs: float | Runs, count: int = RESAMPLES) -> Estimate:
    """A score that does not depend on the rows drawn, such as a chance level: one, or one for each run."""
    same = estimate(np.atleast_1d(runs), np.full(count, np.mean(runs)))
    return replace(same, low=np.nan, high=np.nan)


def scored_row(name: str, control: bool, scores: Iterable[str], values: np.ndarray, **how: Any) -> ScoredRow:
    """A row of (runs, 1 + B, scores) values by ``once_and_resampled``; ``how`` is that of ``estimate``."""
    columns = zip(scores, values[:, 0].T, values[:, 1:].mean(axis=0).T, strict=True)
    own = {score: estimate(runs, resampled, **how) for score, runs, resampled in columns}
    return ScoredRow(name, control, len(values), own)


def difference(ours: Estimate, rivals: Mapping[str, Estimate], *, lower: bool = False) -> Difference:
    """Ours against the best of the rivals; higher is better, or with ``lower`` lower.

    Where ours has no interval the difference has none, and is not called above.
    """
    if not rivals:
        raise ValueError("there is no control to compare with: give at least one")
    sign = -1 if lower else 1
    known = [rival for rival, one in rivals.items() if not np.isnan(one.value)] or list(rivals)
    name = max(known, key=lambda rival: sign * rivals[rival].value)
    low, high = _interval(sign * (ours.resampled - rivals[name].resampled))
    if np.isnan(ours.low):
        low = high = np.nan
    return Difference(name, sign * (ours.value - rivals[name].value), low, high, above=low > 0)


def with_verdicts(rows: Sequence[ScoredRow], *, lower: Collection[str] = ()) -> tuple[ScoredRow, ...]:
    """The rows, those that are no controls compared with the strongest control, score by score.

    Scores named in ``lower`` are better where they are lower.
    """
    controls, judged = [row for row in rows if row.control], []
    for row in rows:
        versus = {}
        for name, one in row.scores.items() if not row.control else ():
            if rivals := {other.name: other.scores[name] for other in controls if name in other.scores}:
                versus[name] = difference(one, rivals, lower=name in lower)
        judged.append(row if row.control else replace(row, versus=versus))
    return tuple(judged)


def _interval(values: np.ndarray) -> tuple[float, float]:
    low, high = np.quantile(values, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(low), float(high)
