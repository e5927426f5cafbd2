"""Clustering protocol: do features group images by a label that training never saw?

Source: Klinghoffer et al., ECCV 2022, Sec. 4: Ward's hierarchical clustering with as many clusters as
classes; accuracy is weighted purity. The paper's CelebA figure is the mean over 40 attributes, each with two
clusters: one cut of one tree. A row that lacks one of several labels is clustered and does not count for that
label; a row without any is left out before. ``majority`` is the score of one single cluster, ``chance`` that
of the first features' clusters with rows dealt at random.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import numpy as np
from scipy.sparse import csr_array, vstack

from derender.evaluation import bootstrap, feature_rows
from derender.evaluation import clustering_scores as measures
from derender.evaluation.clustering_methods import METHODS, approximation, clusterings, finch
from derender.evaluation.memory import Memory
from derender.evaluation.options import Options
from derender.evaluation.score_table import Column, Row, Scores, ScoreTable, judged_tables, verdict
from derender.features import missing


def cluster(
    features: feature_rows.FeatureSource, label: str | Sequence[str] | None = None, *,
    attributes: bool = False, method: str = "ward", clusters: int | None = None, mean_by: Sequence[str] = (),
    min_count: int = 1, max_count: int | None = None, **options: Any,
) -> Scores:  # fmt: skip
    """Cluster features and score the clusters by labels, beside controls; every score is best at 1.

    Args:
        features: a feature table or its ``.parquet`` file; a model or its name, with ``images``.
        label: the label column of the classes; of several the mean.
        attributes: score by every yes/no label instead of ``label``.
        method: "ward", "finch" or "k-means".
        clusters: their number; by default one for each class.
        mean_by: average features first over rows that share these labels, as for face tracks.
        min_count, max_count: leave out classes of fewer rows; use at most so many rows of a class.
        options: images, factors, seed, resamples, cache, ...: the fields of ``Options``.

    Raises:
        ValueError: labels, factors or images do not fit.
    """
    how = Options.of(options, descriptors=label in ("identity", ["identity"], "class", ["class"]))
    rows = feature_rows.subject_and_controls(features, how)
    names, left_out = feature_rows.chosen_labels(rows[0].tables[0], label, attributes)
    mean_by = (mean_by,) if isinstance(mean_by, str) else mean_by
    ready = feature_rows.prepare(rows, names, mean_by=mean_by, min_count=min_count, max_count=max_count)
    result = compare_clusterings(**ready.asked, method=method, n_clusters=clusters, **how.scoring)
    tables = clustering_tables(result, "Above the strongest control? (paired resamples of the rows)")
    levels = {}
    if method == "finch" and len(names) == 1:
        for row in rows:
            levels[row.name] = finch_levels(ready.features[row.name][0], ready.labels[names[0]], how.memory)
            tables.append(finch_table(row.name, levels[row.name], result.labels[names[0]]))
    approximate = approximation(method, result.n_rows)
    judged = verdict(result.rows[0], "accuracy", measures.CLUSTER_COLUMNS["accuracy"])
    notes = [*how.notes, *left_out, judged, *filter(None, [approximate])]
    if ready.n_dropped:
        why = f"without a label of {', '.join((*names, *mean_by))}"
        if min_count > 1 or max_count:
            why += f", or beyond {min_count} to {max_count or 'all'} rows of a class"
        notes.append(f"{ready.n_dropped:,} rows {why} left out")
        result = replace(result, n_dropped=result.n_dropped + ready.n_dropped)
    more = {"approximation": approximate, "n_dropped_before": ready.n_dropped, "finch": levels}
    return Scores(tables, {**result.numbers(), **more}, [*notes, how.memory.summary()])


@dataclass(frozen=True)
class ClusterComparison:
    """Features in the order given, then ``majority`` and ``chance``.

    ``labels`` holds the number of classes by name. ``n_dropped`` rows carry no label and were left out;
    ``n_missing`` single labels are unknown among the others. ``per_label`` has the scores of each first run.
    """

    rows: tuple[bootstrap.ScoredRow, ...]
    method: str
    labels: Mapping[str, int]
    n_rows: int
    n_dropped: int
    n_missing: int
    per_label: Mapping[str, Mapping[str, Mapping[str, float]]]

    def numbers(self) -> dict[str, Any]:
        """Everything as JSON takes it."""
        return {**vars(self), "rows": bootstrap.numbers_of(self.rows)}


def compare_clusterings(
    features: Mapping[str, Sequence[np.ndarray]], labels: Mapping[str, np.ndarray], *,
    controls: Collection[str] = (), method: str = "ward", n_clusters: int | None = None,
    resample_count: int = bootstrap.RESAMPLES, seed: int = 0, memory: Memory | None = None,
) -> ClusterComparison:  # fmt: skip
    """Cluster and score every row of features on the same images.

    ``features`` holds by name one (N, D) array for each run (seed), ``labels`` by name (N,) classes; scores
    are averaged over them. ``controls`` are names of features that learned nothing. There are ``n_clusters``,
    by default as many as the label has classes. k-means is fitted with five seeds, each a run of its own.
    ``memory`` caches the trees.
    """
    if not labels or not features or not all(features.values()):
        raise ValueError("clustering needs at least one label and one array of features in each row")
    columns = {name: np.asarray(values) for name, values in labels.items()}
    feature_rows.check_lengths(features, len(next(iter(columns.values()))))
    labelled = ~np.all([missing(values) for values in columns.values()], axis=0)
    numbers = {name: _numbered(values[labelled], name) for name, values in columns.items()}
    sizes = {name: int(values.max()) + 1 for name, values in numbers.items()}
    clusters = {name: size if n_clusters is None else n_clusters for name, size in sizes.items()}
    n_rows = int(labelled.sum())
    once = np.ones((1, n_rows), np.float32)

    runs, starts = {}, range(seed, seed + (5 if method == "k-means" else 1))
    for name, arrays in features.items():
        fits = [(np.asarray(array)[labelled], start) for array in arrays for start in starts]
        cuts = [clusterings(own, clusters.values(), method, seed=one, memory=memory) for own, one in fits]
        runs[name] = [{label: cut[count] for label, count in clusters.items()} for cut in cuts]
    first = next(iter(runs.values()))[0]
    runs["majority"] = [dict.fromkeys(labels, np.zeros(n_rows, np.int64))]

    scorers = {name: [_scorer(numbers, run) for run in own] for name, own in runs.items()}
    drawn: dict[str, list[np.ndarray]] = {name: [] for name in runs}
    for weights in chain([once], bootstrap.resamples(n_rows, resample_count, seed)):
        for name, own in scorers.items():
            drawn[name].append(np.stack([score(weights) for score in own]))
    rows, per_label = [], {}
    for name, parts in drawn.items():
        values = np.concatenate(parts, axis=1)  # (runs, 1 + resamples, labels, scores)
        quiet = name in {*controls, "majority"}
        mean = values.mean(axis=2)
        rows.append(bootstrap.scored_row(name, quiet, measures.METRICS, mean, centred=True, most=1.0))
        first_run = zip(labels, values[0, 0].tolist(), strict=True)
        per_label[name] = {label: dict(zip(measures.METRICS, own, strict=True)) for label, own in first_run}
    orders = [np.random.default_rng(one).permutation(n_rows) for one in measures.SEEDS]
    deals = [_scorer(numbers, {label: own[order] for label, own in first.items()}) for order in orders]
    chance = np.stack([deal(once)[0].mean(axis=0) for deal in deals], axis=1)
    same = [bootstrap.constant(own, resample_count) for own in chance]
    by_score = dict(zip(measures.METRICS, same, strict=True))
    rows.append(bootstrap.ScoredRow("chance", True, len(deals), by_score))
    n_missing = sum(int((values < 0).sum()) for values in numbers.values())
    judged, dropped = bootstrap.with_verdicts(rows), int((~labelled).sum())
    return ClusterComparison(judged, method, sizes, n_rows, dropped, n_missing, per_label)


def _numbered(values: np.ndarray, name: str) -> np.ndarray:
    """Classes as integers from 0, -1 where missing."""
    classes = measures.encoded(values)
    known, count = int((classes >= 0).sum()), int(classes.max(initial=-1)) + 1
    rows = f"{known} labelled rows of {name!r}"
    if count < 2:
        what = f"clustering needs at least two classes, the {rows} have {count}"
        raise ValueError(f"{what}: choose another label column")
    if count == known:
        fix = "choose a label column whose values repeat"
        raise ValueError(f"every one of the {rows} is a class of its own: {fix}")
    return classes


def _scorer(
    numbers: Mapping[str, np.ndarray], assignment: Mapping[str, np.ndarray]
) -> Callable[[np.ndarray], np.ndarray]:
    """Scores of one clustering: how often each row is drawn, (B, N), to (B, labels, scores).

    The tables of counts of all labels are one product with one sparse matrix.
    """
    shapes, parts = [], []
    for name, classes in numbers.items():
        shapes.append((int(classes.max()) + 1, int(assignment[name].max()) + 1))
        rows = np.flatnonzero(classes >= 0)
        at = (classes * shapes[-1][1] + assignment[name])[rows], rows
        shape = shapes[-1][0] * shapes[-1][1], len(classes)
        parts.append(csr_array((np.ones(len(rows), np.float32), at), shape=shape))
    matrix, ends = vstack(parts, format="csr"), np.cumsum([part.shape[0] for part in parts])[:-1]

    def scores(weights: np.ndarray) -> np.ndarray:
        counts = zip(np.split((matrix @ weights.T).T, ends, axis=1), shapes, strict=True)
        each = [measures.scores_of_counts(part.reshape(-1, *shape)) for part, shape in counts]
        return np.stack(each, axis=1)

    return scores


def clustering_tables(result: ClusterComparison, asked: str) -> list[ScoreTable]:
    """One row for each feature and control, every score; and the verdicts, captioned ``asked``."""
    (name, classes), *others = result.labels.items()
    what = f"mean of {len(result.labels)} labels" if others else f"{classes} classes of {name}"
    caption = f"{METHODS[result.method]}: {result.n_rows:,} rows, {what}"
    if result.n_dropped:
        caption += f"; {result.n_dropped:,} rows without label left out"
    if result.n_missing:
        caption += f"; {result.n_missing:,} single labels unknown"
    return judged_tables(caption, "features", result.rows, measures.CLUSTER_COLUMNS, asked)


@dataclass(frozen=True)
class Level:
    """One partition of FINCH's hierarchy: its number of clusters, their scores, and those by chance."""

    clusters: int
    scores: Mapping[str, float]
    chance: Mapping[str, float]


def finch_levels(features: np.ndarray, labels: np.ndarray, memory: Memory | None = None) -> tuple[Level, ...]:
    """Every partition that FINCH finds in (N, D) features, from fine to coarse, against (N,) labels.

    Rows without label are left out before. Purity and NMI grow with the number of clusters: compare levels of
    different features by ARI and the number of clusters.
    """
    known, levels = ~missing(labels), []
    hierarchy, own = finch(np.asarray(features)[known], memory), np.asarray(labels)[known]
    for count, one in zip(hierarchy.counts, hierarchy.partitions, strict=True):
        levels.append(Level(count, measures.cluster_scores(own, one), measures.chance_scores(own, one)))
    return tuple(levels)


def finch_table(name: str, levels: Sequence[Level], classes: int) -> ScoreTable:
    """FINCH's partitions from fine to coarse, each accuracy beside its own chance level."""
    columns = (
        Column("accuracy", None, note="weighted purity, 0 to 1; grows with the number of clusters"),
        Column("by chance", None, note="accuracy of the same cluster sizes, rows dealt at random"),
        *(measures.CLUSTER_COLUMNS[score] for score in ("nmi", "ari")),
    )
    rows = []
    for one in levels:
        cells = one.scores["accuracy"], one.chance["accuracy"], one.scores["nmi"], one.scores["ari"]
        rows.append(Row(f"{one.clusters:,} clusters", cells))
    return ScoreTable(f"FINCH on {name}: partitions found, {classes} classes", "partition", columns, rows)
