"""Features under one trial: a probe learned in ordinary light and view, its answers at every angle, the area.

The area under a curve of accuracy over angle is taken by trapezia and divided by the range of angles: 0 to 1,
best 1, and it equals the accuracy of an answer that does not care for the angle. Every seed learns from its
own four fifths of what may be learned from. Units (see ``Trial``) are resampled for the intervals, the same
for all features, all angles and both scores, so that differences are paired.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from derender.evaluation.bootstrap import RESAMPLES, ScoredRow, estimate, resamples, with_verdicts
from derender.evaluation.linear_head import PAPER_HEAD, HeadSettings
from derender.evaluation.linear_probes import majority_answers
from derender.evaluation.linear_probing import count_scores, probe_runs
from derender.evaluation.linear_task import Task
from derender.evaluation.memory import Memory
from derender.evaluation.robustness.trial import Curve, Trial

Progress = Callable[[int, int], object]
SCORES = ("accuracy", "balanced_accuracy")
LEARNED_SHARE = 0.8
ORDINARY, AREA = "ordinary", "area"


@dataclass(frozen=True)
class CurveResult:
    """One axis.

    Attributes:
        name, title: of the axis.
        levels: (L,) angles in degrees.
        n_tested: rows tested in ordinary light and view, then at each angle.
        rows: by score, the features in the order given, then ``majority``; each has the scores ``ordinary``,
            ``area`` and, for every angle, ``level_name`` of it.
    """

    name: str
    title: str
    levels: tuple[float, ...]
    n_tested: tuple[int, ...]
    rows: Mapping[str, tuple[ScoredRow, ...]]

    def values(self, row: ScoredRow) -> list[float]:
        """The curve itself: one score for each angle."""
        return [row.scores[level_name(level)].value for level in self.levels]


@dataclass(frozen=True)
class RobustnessComparison:
    """Features side by side.

    Attributes:
        curves: one for each axis.
        how: where other lights and views come from.
        kind, names: of the task.
        head: of the probe.
        n_learned: rows that each probe learned from, by axis.
        n_dropped: rows without a label.
        seeds: of the probes.
    """

    curves: tuple[CurveResult, ...]
    how: str
    kind: str
    names: tuple[str, ...]
    head: str
    n_learned: Mapping[str, int]
    n_dropped: int
    seeds: tuple[int, ...]

    def numbers(self) -> dict[str, Any]:
        """Everything as JSON takes it."""
        sizes = ("how", "kind", "names", "head", "n_learned", "n_dropped", "seeds")
        curves = {
            curve.name: {
                "title": curve.title,
                "levels_deg": curve.levels,
                "n_tested": curve.n_tested,
                **{score: {row.name: row.numbers() for row in rows} for score, rows in curve.rows.items()},
            }
            for curve in self.curves
        }
        return {**{name: getattr(self, name) for name in sizes}, "curves": curves}


def level_name(level: float) -> str:
    """An angle as scores are named by it."""
    return f"{level:.4g} deg"


def area_under(levels: Sequence[float], values: np.ndarray) -> np.ndarray:
    """Area under (..., L) values over L growing levels, divided by their range; by trapezia."""
    x = np.asarray(levels, np.float64)
    if len(x) < 2 or (np.diff(x) <= 0).any():
        raise ValueError(f"an area needs two growing levels or more, got {list(levels)}")
    y = np.asarray(values, np.float64)
    return np.asarray(((y[..., 1:] + y[..., :-1]) / 2 * np.diff(x)).sum(axis=-1) / (x[-1] - x[0]))


def compare_robustness(
    features: Mapping[str, Sequence[np.ndarray]],
    trial: Trial,
    seeds: Sequence[int],
    *,
    controls: Collection[str] = (),
    head: str = "logistic",
    settings: HeadSettings = PAPER_HEAD,
    resample_count: int = RESAMPLES,
    seed: int = 0,
    memory: Memory | None = None,
    progress: Progress | None = None,
) -> RobustnessComparison:
    """Probe every row of features along every curve.

    Args:
        features: by name, one (M, D) array for each run of the same thing, of all pictures of the trial;
            probe seed s uses run s modulo their number.
        trial: who learns, who is tested.
        seeds: (S,) draws of what is learned from.
        controls: names of the features that learned nothing.
        head: kind of probe (``linear_probes.PROBES``).
        settings: of the paper's head.
        resample_count: bootstrap resamples of the units.
        seed: of the resamples.
        memory: where answers are kept.
        progress: called with (probes done, probes in all).

    Raises:
        ValueError: features of another number of rows, no seed, no features.
    """
    for name, arrays in features.items():
        for array in arrays:
            if len(array) != len(trial.task):
                raise ValueError(
                    f"features {name!r} have {len(array)} rows, the trial {len(trial.task)} pictures: make "
                    "features of the trial's own pictures"
                )
    if not features or not all(features.values()) or not len(seeds):
        raise ValueError("a comparison needs one array of features in each row, and a seed")
    shared: dict[bytes, list[Curve]] = {}
    for curve in trial.curves:
        shared.setdefault(curve.learn.tobytes(), []).append(curve)
    total, done, results = len(shared) * len(features), 0, {}
    for curves in shared.values():
        learn = curves[0].learn
        tested = np.unique(np.concatenate([rows for curve in curves for rows in curve.points]))
        draws = draw_rows(learn, seeds)
        answers = {}
        for name, arrays in features.items():
            answers[name] = probe_runs(head, arrays, trial.task, draws, tested, seeds, settings, memory)
            done += 1
            if progress is not None:
                progress(done, total)
        answers["majority"] = majority_answers(trial.task, draws, len(tested))
        quiet = {*controls, "majority"}
        for curve in curves:
            weights = _weights(curve, trial.unit, resample_count, seed)
            results[curve.name] = _result(curve, answers, trial.task, tested, weights, quiet)
    return RobustnessComparison(
        tuple(results[curve.name] for curve in trial.curves),
        trial.how,
        trial.task.kind,
        trial.task.names,
        head,
        {curve.name: draw_rows(curve.learn, seeds[:1]).shape[1] for curve in trial.curves},
        trial.n_dropped,
        tuple(seeds),
    )


def draw_rows(learn: np.ndarray, seeds: Sequence[int]) -> np.ndarray:
    """(S, n) rows that each seed learns from: four fifths, drawn anew."""
    count = max(5, round(LEARNED_SHARE * len(learn)))
    return np.stack([np.random.default_rng(seed).permutation(learn)[:count] for seed in seeds])


def _weights(curve: Curve, unit: np.ndarray, count: int, seed: int) -> list[np.ndarray]:
    """For every point, (B, T) how often each of its rows is drawn: as often as its unit.

    Points that show the same units share their draws; others are drawn apart, so that none is ever empty.
    """
    drawn: dict[bytes, np.ndarray] = {}
    found = []
    for rows in curve.points:
        names, number = np.unique(unit[rows], return_inverse=True)
        key = names.tobytes()
        if key not in drawn:
            drawn[key] = np.concatenate(list(resamples(len(names), count, seed + 1_000 * len(drawn))))
        found.append(drawn[key][:, number])
    return found


def _result(
    curve: Curve,
    answers: Mapping[str, np.ndarray],
    task: Task,
    tested: np.ndarray,
    weights: Sequence[np.ndarray],
    controls: Collection[str],
) -> CurveResult:
    places = [np.searchsorted(tested, rows) for rows in curve.points]
    truths = [task.targets[rows] for rows in curve.points]
    once = [np.ones((1, len(rows)), np.float32) for rows in curve.points]
    found: dict[str, list[ScoredRow]] = {score: [] for score in SCORES}
    for name, runs in answers.items():
        plain = np.stack([_scores(truths, places, run, task.kind, once) for run in runs])  # (S, points, 2)
        resampled = np.mean([_scores(truths, places, run, task.kind, weights) for run in runs], axis=0)
        for at, score in enumerate(SCORES):
            own, drawn = plain[:, :, 0, at], resampled[:, :, at]  # (S, points), (points, B)
            scores = {ORDINARY: estimate(own[:, 0].tolist(), drawn[0])}
            area = area_under(curve.levels, own[:, 1:])
            scores[AREA] = estimate(area.tolist(), area_under(curve.levels, drawn[1:].T))
            for place, level in enumerate(curve.levels, 1):
                scores[level_name(level)] = estimate(own[:, place].tolist(), drawn[place])
            found[score].append(ScoredRow(name, name in controls, len(runs), scores))
    return CurveResult(
        curve.name,
        curve.title,
        curve.levels,
        tuple(len(rows) for rows in curve.points),
        {score: with_verdicts(rows) for score, rows in found.items()},
    )


def _scores(
    truths: Sequence[np.ndarray],
    places: Sequence[np.ndarray],
    run: np.ndarray,
    kind: str,
    weights: Sequence[np.ndarray],
) -> np.ndarray:
    """(points, B, 2) both scores at every point, given how often each of its rows is drawn, (B, T) each."""
    found = [
        count_scores(truth, run[place], kind, weight)
        for truth, place, weight in zip(truths, places, weights, strict=True)
    ]
    return np.stack(found)
