"""Clustering protocol: do features group images by a label that training never saw?

Source: Klinghoffer et al., ECCV 2022, Sec. 4: Ward's hierarchical clustering with as many clusters as
    classes; accuracy is weighted purity. The paper's CelebA figure is the mean over 40 attributes, each
    with two clusters: one cut of one tree. A row that lacks one of several labels is clustered and does not
    count for that label; a row without any is left out before. Beside the controls of the images
    (controls.py) stand ``majority``, the score of one single cluster, and ``chance``, the first features'
    clusters with rows dealt at random.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from derender.data import ImageSet
from derender.evaluation.bootstrap import (
    RESAMPLES,
    ScoredRow,
    constant,
    estimate,
    resamples,
    with_verdicts,
)
from derender.evaluation.clustering_methods import METHODS, approximation, clusterings, finch_hierarchy
from derender.evaluation.clustering_scores import (
    CLUSTER_COLUMNS,
    METRICS,
    SEEDS,
    chance_scores,
    cluster_scores,
    encoded,
    scores_of_counts,
)
from derender.evaluation.controls import image_notes, subject_and_controls
from derender.evaluation.feature_rows import (
    DEFAULT_FACTORS,
    FeatureSource,
    StageProgress,
    chosen_labels,
    prepare,
    sized,
)
from derender.evaluation.memory import Memory, memory_in
from derender.evaluation.score_table import (
    Column,
    Row,
    Scores,
    ScoreTable,
    scored_table,
    verdict,
    verdict_table,
)
from derender.features import missing

K_MEANS_SEEDS = 5


def cluster(
    features: FeatureSource,
    label: str | Sequence[str] | None = None,
    *,
    images: ImageSet | str | Path | None = None,
    attributes: bool = False,
    factors: Sequence[str] | None = DEFAULT_FACTORS,
    method: str = "ward",
    clusters: int | None = None,
    mean_by: Sequence[str] = (),
    min_count: int = 1,
    max_count: int | None = None,
    untrained_seeds: int = 3,
    whiten_on: ImageSet | str | Path | None = None,
    resamples: int = RESAMPLES,
    seed: int = 0,
    dataset: str = "auto",
    limit: int | None = None,
    device: str = "auto",
    cache: Memory | str | Path | None = None,
    progress: StageProgress | None = None,
) -> Scores:
    """Cluster features and score the clusters by labels, beside controls; every score is best at 1.

    Args:
        features: a feature table or its ``.parquet`` file; a model or its name, with ``images``.
        label: the label column of the classes; of several the mean.
        images: a data set or its address: of the model, and of the controls. Without it there are no pixels,
            PCA and untrained encoder to compare with.
        attributes: score by every yes/no label instead of ``label``.
        factors: features to use, side by side; None means all.
        method: "ward", "finch" or "k-means".
        clusters: their number; by default one for each class.
        mean_by: average features first over rows that share these labels, as for face tracks.
        min_count, max_count: leave out classes of fewer rows; use at most so many rows of a class.
        untrained_seeds: untrained encoders to average over.
        whiten_on: also score the model without whitening, and controls whitened by its renderings of these
            images.
        resamples: bootstrap resamples of the rows.
        seed: of resamples, k-means and untrained encoders.
        dataset, limit: how ``images`` are read.
        device: of models.
        cache: folder of cached results, "none" for none; by default the user's.
        progress: called with (done, total, description=..., unit=...).

    Raises:
        ValueError: labels, factors or images do not fit.
    """
    memory = memory_in(cache)
    read = sized(images, dataset=dataset, limit=limit, progress=progress)
    rows = subject_and_controls(
        features, read, factors, range(seed, seed + untrained_seeds), memory=memory, device=device,
        whiten_on=whiten_on, progress=progress,
    )  # fmt: skip
    names, left_out = chosen_labels(rows[0].tables[0], label, attributes)
    ready = prepare(rows, names, mean_by=mean_by, min_count=min_count, max_count=max_count)
    found = compare_clusterings(
        ready.features, ready.labels, controls=ready.controls, method=method, n_clusters=clusters,
        resample_count=resamples, seed=seed, memory=memory,
    )  # fmt: skip
    tables, levels = clustering_tables(found), {}
    if method == "finch" and len(names) == 1:
        for row in rows:
            levels[row.name] = finch_levels(ready.features[row.name][0], ready.labels[names[0]], memory)
            tables.append(finch_table(row.name, levels[row.name], found.labels[names[0]]))
    approximate = approximation(method, found.n_rows)
    notes = [
        *image_notes(read),
        *left_out,
        verdict(found.rows[0], "accuracy"),
        *([approximate] if approximate else []),
    ]
    if ready.n_dropped:
        notes.append(f"{ready.n_dropped:,} rows without a label of {', '.join((*names, *mean_by))} left out")
    more = {"approximation": approximate, "n_dropped_before": ready.n_dropped, "finch": levels}
    return Scores(tables, {**found.numbers(), **more}, [*notes, memory.summary()])


@dataclass(frozen=True)
class ClusterComparison:
    """Features side by side.

    Attributes:
        rows: the features in the order given, then ``majority`` and ``chance``.
        method: of clustering.
        labels: by name, the number of classes.
        n_rows: rows clustered.
        n_dropped: rows left out because they carry none of the labels.
        n_missing: single labels that are missing among the rows clustered.
        per_label: by row and label, the scores of the first run.
    """

    rows: tuple[ScoredRow, ...]
    method: str
    labels: Mapping[str, int]
    n_rows: int
    n_dropped: int
    n_missing: int
    per_label: Mapping[str, Mapping[str, Mapping[str, float]]]

    def numbers(self) -> dict[str, Any]:
        """Everything as JSON takes it."""
        return {**vars(self), "rows": {row.name: row.numbers() for row in self.rows}}

    @property
    def about(self) -> str:
        """Method, rows and labels in words."""
        return about_clustering(self.method, self.n_rows, self.labels)


def about_clustering(method: str, n_rows: int, labels: Mapping[str, int]) -> str:
    """Method, rows and labels in words; ``labels`` holds the number of classes by name."""
    (name, classes), *others = labels.items()
    what = f"mean of {len(labels)} labels" if others else f"{classes} classes of {name}"
    return f"{METHODS[method]}: {n_rows:,} rows, {what}"


def compare_clusterings(
    features: Mapping[str, Sequence[np.ndarray]],
    labels: Mapping[str, np.ndarray],
    *,
    controls: Collection[str] = (),
    method: str = "ward",
    n_clusters: int | None = None,
    resample_count: int = RESAMPLES,
    seed: int = 0,
    memory: Memory | None = None,
) -> ClusterComparison:
    """Cluster and score every row of features on the same images.

    Args:
        features: by name, one (N, D) array for each run (seed) of the same thing.
        labels: by name, (N,) classes; scores are averaged over them.
        controls: names of the features that learned nothing.
        method: see ``clusterings``; k-means is fitted with five seeds, each a run of its own.
        n_clusters: by default as many as the label has classes.
        resample_count: bootstrap resamples of the rows.
        seed: of the resamples and of k-means.
        memory: where trees are cached.
    """
    labelled = _labelled(features, labels)
    numbers = {name: _numbered(np.asarray(values)[labelled], name) for name, values in labels.items()}
    sizes = {name: int(values.max()) + 1 for name, values in numbers.items()}
    clusters = {name: n_clusters or size for name, size in sizes.items()}
    method_seeds = range(seed, seed + K_MEANS_SEEDS) if method == "k-means" else (seed,)
    n_rows = int(labelled.sum())

    runs: dict[str, list[dict[str, np.ndarray]]] = {}
    for name, arrays in features.items():
        runs[name] = []
        for array in arrays:
            for one in method_seeds:
                own = np.asarray(array)[labelled]
                cuts = clusterings(own, clusters.values(), method, seed=one, memory=memory)
                runs[name].append({label: cuts[count] for label, count in clusters.items()})
    runs["majority"] = [dict.fromkeys(labels, np.zeros(n_rows, np.int64))]

    tables = [_CountTables(numbers, run) for assignments in runs.values() for run in assignments]
    plain = [table.scores(np.ones((1, n_rows), np.float32))[0] for table in tables]
    portions = [
        np.stack([table.scores(weights).mean(axis=1) for table in tables])
        for weights in resamples(n_rows, resample_count, seed)
    ]
    resampled = np.concatenate(portions, axis=1)  # (runs, resamples, scores)
    rows, per_label, start = [], {}, 0
    for name, assignments in runs.items():
        part = slice(start, start + len(assignments))
        control = name in controls or name == "majority"
        rows.append(_row(name, np.array(plain[part]), resampled[part], control))
        per_label[name] = {
            label: dict(zip(METRICS, plain[start][at].tolist(), strict=True))
            for at, label in enumerate(labels)
        }
        start += len(assignments)
    rows.append(_chance(numbers, next(iter(runs.values()))[0], resample_count))
    n_missing = sum(int((values < 0).sum()) for values in numbers.values())
    dropped = int((~labelled).sum())
    return ClusterComparison(with_verdicts(rows), method, sizes, n_rows, dropped, n_missing, per_label)


def clustering_table(found: ClusterComparison) -> ScoreTable:
    """One row for each feature and control, every score."""
    caption = found.about
    if found.n_dropped:
        caption += f"; {found.n_dropped:,} rows without label left out"
    if found.n_missing:
        caption += f"; {found.n_missing:,} single labels unknown"
    return scored_table(caption, "features", found.rows, CLUSTER_COLUMNS)


def clustering_tables(found: ClusterComparison) -> list[ScoreTable]:
    """Scores, and the differences to the strongest control."""
    caption = "Above the strongest control? (paired resamples of the rows)"
    return [clustering_table(found), verdict_table(found.rows, CLUSTER_COLUMNS, caption)]


@dataclass(frozen=True)
class Level:
    """One partition of FINCH's hierarchy: its number of clusters, their scores, and those by chance."""

    clusters: int
    scores: Mapping[str, float]
    chance: Mapping[str, float]


def finch_levels(features: np.ndarray, labels: np.ndarray, memory: Memory | None = None) -> tuple[Level, ...]:
    """Every partition that FINCH finds in (N, D) features, from fine to coarse, against (N,) labels.

    Rows without label are left out before. Purity and NMI grow with the number of clusters, so levels of
    different features are not comparable by these alone; ARI and the number of clusters are.
    """
    labels = np.asarray(labels)
    known = ~missing(labels)
    hierarchy = finch_hierarchy(np.asarray(features)[known], memory)
    return tuple(
        Level(count, cluster_scores(labels[known], partition), chance_scores(labels[known], partition))
        for count, partition in zip(hierarchy.counts, hierarchy.partitions, strict=True)
    )


def finch_table(name: str, levels: Sequence[Level], classes: int) -> ScoreTable:
    """FINCH's partitions from fine to coarse, each accuracy beside its own chance level."""
    columns = (
        Column("accuracy", None, note="weighted purity, 0 to 1; grows with the number of clusters"),
        Column("by chance", None, note="accuracy of the same cluster sizes, rows dealt at random"),
        CLUSTER_COLUMNS["nmi"],
        CLUSTER_COLUMNS["ari"],
    )
    rows = [
        Row(
            f"{level.clusters:,} clusters",
            (level.scores["accuracy"], level.chance["accuracy"], level.scores["nmi"], level.scores["ari"]),
        )
        for level in levels
    ]
    return ScoreTable(f"FINCH on {name}: partitions found, {classes} classes", "partition", columns, rows)


class _CountTables:
    """The table of counts of each label as a product of how often each row is drawn: one sparse matrix."""

    def __init__(self, numbers: Mapping[str, np.ndarray], assignment: Mapping[str, np.ndarray]):
        self.shapes, rows, cells, start = [], [], [], 0
        for name, classes in numbers.items():
            shape = int(classes.max()) + 1, int(assignment[name].max()) + 1
            known = np.flatnonzero(classes >= 0)
            rows.append(known)
            cells.append(start + classes[known] * shape[1] + assignment[name][known])
            self.shapes.append(shape)
            start += shape[0] * shape[1]
        n_rows = len(next(iter(numbers.values())))
        at = np.concatenate(cells), np.concatenate(rows)
        self.matrix = csr_array((np.ones(len(at[0]), np.float32), at), shape=(start, n_rows))

    def scores(self, weights: np.ndarray) -> np.ndarray:
        """(B, labels, scores) of B resamples, given how often each row is drawn, (B, N)."""
        counts, found, start = (self.matrix @ weights.T).T, [], 0
        for shape in self.shapes:
            size = shape[0] * shape[1]
            found.append(scores_of_counts(counts[:, start : start + size].reshape(-1, *shape)))
            start += size
        return np.stack(found, axis=1)


def _row(name: str, plain: np.ndarray, resampled: np.ndarray, control: bool) -> ScoredRow:
    """From (runs, labels, scores) and (runs, B, scores) of resamples."""
    scores = {
        score: estimate(
            plain[:, :, at].mean(axis=1).tolist(), resampled[:, :, at].mean(axis=0), centred=True, most=1.0
        )
        for at, score in enumerate(METRICS)
    }
    return ScoredRow(name, control, len(plain), scores)


def _chance(numbers: Mapping[str, np.ndarray], assignment: Mapping[str, np.ndarray], count: int) -> ScoredRow:
    deals = []
    for seed in SEEDS:
        order = np.random.default_rng(seed).permutation(len(next(iter(numbers.values()))))
        dealt = _CountTables(numbers, {name: clusters[order] for name, clusters in assignment.items()})
        deals.append(dealt.scores(np.ones((1, len(order)), np.float32))[0].mean(axis=0))
    mean, deviation = np.mean(deals, axis=0), np.std(deals, axis=0, ddof=1)
    scores = {
        score: constant(float(mean[at]), count, float(deviation[at])) for at, score in enumerate(METRICS)
    }
    return ScoredRow("chance", True, len(deals), scores)


def _labelled(features: Mapping[str, Sequence[np.ndarray]], labels: Mapping[str, np.ndarray]) -> np.ndarray:
    """Which rows carry a label at all, (N,) bool, once everything is of one length."""
    if not labels or not features or not all(features.values()):
        raise ValueError("clustering needs at least one label and one array of features in each row")
    n_rows = len(next(iter(labels.values())))
    for what, length in (
        *((f"features {name!r}", len(array)) for name, arrays in features.items() for array in arrays),
        *((f"label {name!r}", len(values)) for name, values in labels.items()),
    ):
        if length != n_rows:
            raise ValueError(
                f"{what} has {length} rows, the others {n_rows}: all features and labels of one table must "
                "be of the same images"
            )
    return ~np.all([missing(np.asarray(values)) for values in labels.values()], axis=0)


def _numbered(values: np.ndarray, name: str) -> np.ndarray:
    """Classes as integers from 0, -1 where missing."""
    known = ~missing(values)
    classes = np.full(len(values), -1, np.int64)
    if known.any():
        classes[known] = encoded(values[known])
    if classes.max(initial=-1) < 1:
        raise ValueError(
            f"clustering needs at least two classes, the {int(known.sum())} labelled rows of {name!r} have "
            f"{classes.max(initial=-1) + 1}: choose another label column"
        )
    if classes.max() + 1 == known.sum():
        raise ValueError(
            f"every one of the {int(known.sum())} labelled rows of {name!r} is a class of its own: choose a "
            "label column whose values repeat"
        )
    return classes
