"""The robustness protocol: a probe learns in ordinary light and view and is tested at every angle.

The area under a curve of accuracy over angle is divided by the range of angles: 0 to 1, best 1. Every seed
learns from its own four fifths of the training rows. Units (see ``Trial``) are resampled, the same for all
features, angles and scores, so that differences are paired.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import trapezoid

from derender.data import ImageSet
from derender.evaluation import bootstrap, feature_rows, trials
from derender.evaluation.linear_probes import PROBES, majority_answers, probe_runs
from derender.evaluation.linear_task import count_scores, divide_rows, task_of
from derender.evaluation.memory import Memory
from derender.evaluation.options import Options
from derender.evaluation.score_table import Column, Row, Scores, ScoreTable, judged_tables, verdict
from derender.evaluation.trials import LEVELS, Curve, Trial
from derender.features import FeatureTable, named, table_labels
from derender.inputs import Progress, as_model

WAYS = (*trials.LABELS, "render", "truth")
SCORES = {"accuracy": "accuracy", "balanced_accuracy": "balanced accuracy"}  # names in tables and charts
LEARNED_SHARE = 0.8
ORDINARY, AREA = "ordinary", "area"
_AREA = Column("area", "high", note="mean height of the curve over the angles, 0 to 1, best 1")
_ORDINARY = Column("ordinary", "high", note="other images in the light and view of the training images")
_LOST = Column("lost", None, note="ordinary less area; read it beside ordinary, since chance loses nothing")


def robustness(
    models: Mapping[str, feature_rows.ModelSource] | feature_rows.ModelSource,
    images: ImageSet | str | Path | None = None, *, pictures: str | None = None,
    label: str | Sequence[str] | None = None, attributes: bool = False, min_count: int = 1,
    max_count: int | None = None, groups: str | None = None, test_fraction: float = 0.3,
    axes: Sequence[str] = ("yaw", "light"), angles: Sequence[float] = LEVELS, people: int = 40,
    learned: int = 8, tested: int = 2, head: str = "logistic", score: str = "accuracy", seeds: int = 5,
    untrained_seeds: int = 5, **options: Any,
) -> Scores:  # fmt: skip
    """Does a probe learned in ordinary light and view hold in others? Curves over angles, area 1 is best.

    Args:
        models: a model, or several by name; the first one re-renders, and is the subject of the tables.
        images: to re-render, or with true angles among their labels; None where images are generated.
        pictures: "faces" or "cars" (generated), "render" or "truth"; by default faces, with images render.
        label: the question: by default identity, of cars their class; several yes/no labels are averaged.
        attributes: ask every yes/no label of the images.
        min_count, max_count: leave out classes of fewer rows; use at most so many rows of a class.
        groups: label whose rows stay on one side of the split.
        test_fraction: tested share of the images that are re-rendered.
        axes, angles: names of ``AXES``, and degrees off the front, growing.
        people, learned, tested: of generated images, see ``Recipe``.
        head: kind of probe.
        score: "accuracy" or "balanced_accuracy", shown in the tables.
        seeds, untrained_seeds: numbers of training subsets and of untrained encoders.
        options: factors, seed, resamples, cache, ...: the fields of ``Options``.

    Returns:
        The tables; ``result`` is the ``RobustnessComparison``.
    """
    how = Options.of(options, images=images, untrained_seeds=untrained_seeds)
    way = pictures or ("faces" if images is None else "render")
    named(dict.fromkeys(WAYS), way, "kind of images")
    named(SCORES, score, "score")
    named(PROBES, head, "head")
    generated, names = way in trials.LABELS, [label] if isinstance(label, str) else list(label or ())
    if generated == (images is not None):
        what = "are generated and take no images" if generated else "need images"
        raise ValueError(f"images {way!r} {what}")
    if generated and (attributes or groups or len(names) > 1):
        raise ValueError(f"images {way!r} are asked one label; attributes and groups need images")
    turned = trials.chosen_axes(axes, way if generated else None)
    levels = trials.checked_levels(angles, turned)
    given = models if isinstance(models, Mapping) else {"model": models}
    nets = {name: as_model(one, device=how.device) for name, one in given.items()}
    first = next(iter(nets.values()))
    if generated:
        name = names[0] if names else trials.LABELS[way]
        recipe = trials.Recipe(way, name, people, learned, tested, first.image_size, how.seed)
        trial = trials.generated_trial(recipe, turned, levels, how)
    else:
        read = how.at(first.image_size)
        columns = FeatureTable(read.files, {"none": np.zeros((len(read), 1))}, table_labels(read))
        if not names and not attributes:
            names = [name for name in ("identity", "class") if name in columns.labels][:1]
        chosen, left_out = feature_rows.chosen_labels(columns, names, attributes, 2)
        how.notes.extend(left_out)
        sizes = {"min_count": min_count, "max_count": max_count}
        ready = feature_rows.prepare([feature_rows.FeatureRow("images", (columns,))], chosen, **sizes)
        side = ready.table.label(groups) if groups else None
        read, task = how.at(first.image_size, ready.table.files), task_of(ready.labels)
        if way == "truth":
            trial = trials.true_angle_trial(read, task, turned)
        else:
            parts = divide_rows(task, **ready.split, test_fraction=test_fraction, groups=side)
            trial = trials.rendered_trial(first, read, task, *parts, turned, levels, how, side)
    rows = []
    for name, net in nets.items():
        table = feature_rows.embedded_table(net, trial.pictures, how, f"embedding {name}")
        joined, prefix = " + ".join(how.chosen or table.factors), f"{name}: " if len(nets) > 1 else ""
        single = {one: (one,) for one in table.factors if not rows and one != joined}
        shown = {joined: how.chosen, **single}
        rows += [feature_rows.FeatureRow(f"{prefix}{one}", (table,), own) for one, own in shown.items()]
    fit_on = trial.pictures.select(np.unique(np.concatenate([curve.learn for curve in trial.curves])))
    rows += feature_rows.control_rows(trial.pictures, first.settings, how, fit_on=fit_on)
    features, quiet = {row.name: row.arrays() for row in rows}, [row.name for row in rows if row.control]
    same: Any = {**how.scoring, "controls": quiet, "head": head, "progress": how.stage("probing", "probes")}
    result = compare_robustness(features, trial, how.seeds(seeds), **same)
    notes = [*how.notes, f"{len(trial.images):,} images: {trial.how}"]
    notes += [f"{curve.title}: {verdict(curve.rows[score][0], AREA, _AREA)}" for curve in result.curves]
    address = images.source if isinstance(images, ImageSet) else images
    values = {"pictures": way, "data": None if address is None else str(address), **result.numbers()}
    return Scores(result.tables(score), values, [*notes, how.memory.summary()], result=result)


@dataclass(frozen=True)
class CurveResult:
    """One axis: angles in degrees, and the rows tested in ordinary light and view, then at each angle.

    ``rows`` holds, by score, the features in the order given, then ``majority``; each has the scores
    ``ordinary``, ``area`` and, for every angle, ``level_name`` of it.
    """

    name: str
    title: str
    levels: tuple[float, ...]
    n_tested: tuple[int, ...]
    rows: Mapping[str, tuple[bootstrap.ScoredRow, ...]]

    def values(self, row: bootstrap.ScoredRow) -> list[float]:
        """The curve itself: one score for each angle."""
        return [row.scores[level_name(level)].value for level in self.levels]


@dataclass(frozen=True)
class RobustnessComparison:
    """Features side by side, a curve for each axis.

    ``how`` is the source of other lights and views. ``kind`` and ``names`` are of the task, ``head`` and
    ``seeds`` of the probes, ``n_learned`` their training rows by axis. ``n_dropped`` rows have no label.
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
        """Everything for JSON."""
        curves = {}
        for curve in self.curves:
            facts = {"title": curve.title, "levels_deg": curve.levels, "n_tested": curve.n_tested}
            scores = {score: bootstrap.numbers_of(rows) for score, rows in curve.rows.items()}
            curves[curve.name] = facts | scores
        return {**vars(self), "curves": curves}

    def tables(self, score: str = "accuracy") -> list[ScoreTable]:
        """For every axis the areas, the curve in numbers, and the verdicts against the controls."""
        tables, task = [], f"{len(self.names)} classes"
        if self.kind != "classes":
            task = self.names[0] if len(self.names) == 1 else f"{len(self.names)} yes/no labels"
        dropped = f"; {self.n_dropped:,} images without label left out" if self.n_dropped else ""
        for curve in self.curves:
            rows, last = curve.rows[score], curve.levels[-1]
            caption = (
                f"{curve.title}, {curve.levels[0]:.0f} to {last:.0f} degrees: {SCORES[score]} of {task}, "
                f"{self.how}; {self.head} probes on {self.n_learned[curve.name]:,} images, "
                f"{curve.n_tested[0]:,} to {max(curve.n_tested):,} tested, {len(self.seeds)} seeds{dropped}"
            )
            at_last = Column(f"at {last:.0f} deg", "high", note="the curve's last point")
            more = {at_last: lambda row, last=last: row.scores[level_name(last)].value}
            more |= {_LOST: lambda row: row.scores[ORDINARY].value - row.scores[AREA].value}
            angles = [Column(f"{level:.0f}", "high") for level in curve.levels]
            points = [Row(row.name, curve.values(row), row.control) for row in rows]
            asked = f"{curve.title}: above the strongest control?"
            columns = {AREA: _AREA, ORDINARY: _ORDINARY}
            areas, judged = judged_tables(caption, "features", rows, columns, asked, more=more)
            levels = ScoreTable(f"{curve.title} in degrees: {SCORES[score]}", "features", angles, points)
            tables += [areas, levels, judged]
        return tables


def level_name(level: float) -> str:
    """The name of the score at an angle."""
    return f"{level:.4g} deg"


def area_under(levels: Sequence[float], values: np.ndarray) -> np.ndarray:
    """Area under (..., L) values over L growing levels, divided by their range; by trapezia."""
    if len(levels) < 2 or (np.diff(levels) <= 0).any():
        raise ValueError(f"an area needs two growing levels or more, got {list(levels)}")
    return np.asarray(trapezoid(values, levels, axis=-1) / (levels[-1] - levels[0]))


def compare_robustness(
    features: Mapping[str, Sequence[np.ndarray]], trial: Trial, seeds: Sequence[int], *,
    controls: Collection[str] = (), head: str = "logistic", resample_count: int = bootstrap.RESAMPLES,
    seed: int = 0, memory: Memory | None = None, progress: Progress | None = None,
) -> RobustnessComparison:  # fmt: skip
    """Probe every row of features along every curve of a trial.

    ``features`` holds by name one (M, D) array for each run of the same features, of all images of the trial.
    Of the (S,) seeds of training subsets, seed s uses run s modulo their number. ``controls`` are names of
    features that learned nothing, ``head`` one of ``PROBES``; resamples are of the units. ``progress`` is
    called with (probes done, probes in all).
    """
    task = trial.task
    feature_rows.check_lengths(features, len(task))
    if not features or not all(features.values()) or not len(seeds):
        raise ValueError("a comparison needs one array of features in each row, and a seed")
    tested = np.unique(np.concatenate([rows for curve in trial.curves for rows in curve.points]))

    def scored(curve: Curve, answers: Mapping[str, np.ndarray]) -> dict[str, tuple[bootstrap.ScoredRow, ...]]:
        """By score, a row for each of the (S, T, A) answers for the rows ``tested``."""
        asked, draws = [], {}  # points of the same units share a draw, others never lack rows
        for rows in curve.points:
            unit = trial.unit[rows]
            start = seed + 1_000 * draws.setdefault(np.unique(unit).tobytes(), len(draws))
            weights = bootstrap.once_and_resampled(unit, resample_count, start)
            asked.append((task.targets[rows], np.searchsorted(tested, rows), weights))
        names = (ORDINARY, AREA, *map(level_name, curve.levels))

        def scores(run: np.ndarray) -> np.ndarray:
            """(1 + B, 1 + points, 2) both scores, the area second."""
            ordinary, *levels = (count_scores(truth, run[at], task.kind, own) for truth, at, own in asked)
            area = area_under(curve.levels, np.stack(levels, axis=-1))
            return np.stack((ordinary, area, *levels), axis=1)

        result: dict[str, list[bootstrap.ScoredRow]] = {score: [] for score in SCORES}
        for name, runs in answers.items():
            both = np.stack([scores(run) for run in runs])
            for at, rows in enumerate(result.values()):
                rows.append(bootstrap.scored_row(name, name in {*controls, "majority"}, names, both[..., at]))
        return {score: bootstrap.with_verdicts(rows) for score, rows in result.items()}

    known: dict[bytes, dict[str, np.ndarray]] = {}  # answers by training rows: most curves share these
    total, curves, n_learned = len({one.learn.tobytes() for one in trial.curves}) * len(features), [], {}
    for curve in trial.curves:
        count = n_learned[curve.name] = max(5, round(LEARNED_SHARE * len(curve.learn)))
        draws = np.stack([np.random.default_rng(one).permutation(curve.learn)[:count] for one in seeds])
        answers = known.setdefault(curve.learn.tobytes(), {})
        if not answers:
            for name, arrays in features.items():
                answers[name] = probe_runs(head, arrays, task, draws, tested, seeds, memory=memory)
                if progress is not None:
                    progress(sum(map(len, known.values())), total)
        both = {**answers, "majority": majority_answers(task, draws, len(tested))}
        sizes = tuple(map(len, curve.points))
        curves.append(CurveResult(curve.name, curve.title, curve.levels, sizes, scored(curve, both)))
    return RobustnessComparison(
        tuple(curves), trial.how, task.kind, task.names, head, n_learned, trial.n_dropped, tuple(seeds)
    )
