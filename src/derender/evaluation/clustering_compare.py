"""Several features clustered under one protocol: one tree each for all labels, intervals, controls.

The paper's CelebA figure is the mean over 40 attributes, each with two clusters: one cut of one tree. A row
that lacks one of several labels is clustered and does not count for that label; a row without any is left
out before. Every control is a row of its own; ``majority`` is what one single cluster scores, ``chance``
the first features' clusters with rows dealt at random.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from derender.evaluation.bootstrap import (
    RESAMPLES,
    ScoredRow,
    constant,
    estimate,
    resamples,
    with_verdicts,
)
from derender.evaluation.clustering_methods import clusterings
from derender.evaluation.clustering_scores import SEEDS, ClusterScores, encoded, scores_of_counts
from derender.evaluation.memory import Memory
from derender.features import missing

SCORES = tuple(field.name for field in fields(ClusterScores))
K_MEANS_SEEDS = 5


@dataclass(frozen=True)
class ClusterComparison:
    """Features side by side.

    Attributes:
        rows: the features in the order given, then ``majority`` and ``chance``.
        method: how they were clustered.
        labels: by name, the number of classes.
        n_rows: rows clustered.
        n_dropped: rows left out because they carry none of the labels.
        n_missing: single labels that are missing among the rows clustered.
        per_label: by row and label, the five scores of the first run.
    """

    rows: tuple[ScoredRow, ...]
    method: str
    labels: Mapping[str, int]
    n_rows: int
    n_dropped: int
    n_missing: int
    per_label: Mapping[str, Mapping[str, ClusterScores]]

    def numbers(self) -> dict[str, Any]:
        """Everything as JSON takes it."""
        sizes = {
            name: getattr(self, name) for name in ("method", "labels", "n_rows", "n_dropped", "n_missing")
        }
        rows = {row.name: row.numbers() for row in self.rows}
        return {**sizes, "rows": rows, "per_label": self.per_label}


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
    """Cluster and score every row of features on the same pictures.

    Args:
        features: by name, one (N, D) array for each run (seed) of the same thing.
        labels: by name, (N,) classes; scores are averaged over them.
        controls: names of the features that learned nothing.
        method: see ``clusterings``; k-means is fitted with five seeds, each a run of its own.
        n_clusters: by default as many as the label has classes.
        resample_count: bootstrap resamples of the rows.
        seed: of the resamples and of k-means.
        memory: where trees are kept.
    """
    kept = _labelled(features, labels)
    columns = {name: np.asarray(values)[kept] for name, values in labels.items()}
    numbers = {name: _numbered(values, name) for name, values in columns.items()}
    sizes = {name: int(values.max()) + 1 for name, values in numbers.items()}
    clusters = {name: n_clusters or size for name, size in sizes.items()}
    method_seeds = range(seed, seed + K_MEANS_SEEDS) if method == "k-means" else (seed,)

    runs: dict[str, list[dict[str, np.ndarray]]] = {}
    for name, arrays in features.items():
        runs[name] = []
        for array in arrays:
            for one in method_seeds:
                cuts = clusterings(
                    np.asarray(array)[kept], clusters.values(), method, seed=one, memory=memory
                )
                runs[name].append({label: cuts[count] for label, count in clusters.items()})
    n_rows = int(kept.sum())
    runs["majority"] = [dict.fromkeys(labels, np.zeros(n_rows, np.int64))]

    tables = [_Cells(numbers, run) for assignments in runs.values() for run in assignments]
    plain = [table.scores(np.ones((1, n_rows), np.float32))[0] for table in tables]
    portions = [
        np.stack([table.scores(weights).mean(axis=1) for table in tables])
        for weights in resamples(n_rows, resample_count, seed)
    ]
    resampled = np.concatenate(portions, axis=1)  # (runs, resamples, scores)
    rows, per_label, start = [], {}, 0
    for name, assignments in runs.items():
        part = slice(start, start + len(assignments))
        rows.append(
            _row(name, np.array(plain[part]), resampled[part], name in controls or name == "majority")
        )
        per_label[name] = {
            label: ClusterScores(*plain[start][at].tolist()) for at, label in enumerate(labels)
        }
        start += len(assignments)
    rows.append(_chance(numbers, next(iter(runs.values()))[0], resample_count))
    return ClusterComparison(
        with_verdicts(rows),
        method,
        sizes,
        n_rows,
        n_dropped=int((~kept).sum()),
        n_missing=sum(int((values < 0).sum()) for values in numbers.values()),
        per_label=per_label,
    )


class _Cells:
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
        """(B, labels, 5) scores of B resamples, given how often each row is drawn, (B, N)."""
        counts, found, start = (self.matrix @ weights.T).T, [], 0
        for shape in self.shapes:
            size = shape[0] * shape[1]
            found.append(scores_of_counts(counts[:, start : start + size].reshape(-1, *shape)))
            start += size
        return np.stack(found, axis=1)


def _row(name: str, plain: np.ndarray, resampled: np.ndarray, control: bool) -> ScoredRow:
    """From (runs, labels, 5) scores and (runs, B, 5) resampled ones."""
    scores = {
        score: estimate(
            plain[:, :, at].mean(axis=1).tolist(), resampled[:, :, at].mean(axis=0), centred=True, most=1.0
        )
        for at, score in enumerate(SCORES)
    }
    return ScoredRow(name, control, len(plain), scores)


def _chance(numbers: Mapping[str, np.ndarray], assignment: Mapping[str, np.ndarray], count: int) -> ScoredRow:
    deals = []
    for seed in SEEDS:
        order = np.random.default_rng(seed).permutation(len(next(iter(numbers.values()))))
        dealt = _Cells(numbers, {name: clusters[order] for name, clusters in assignment.items()})
        deals.append(dealt.scores(np.ones((1, len(order)), np.float32))[0].mean(axis=0))
    mean, spread = np.mean(deals, axis=0), np.std(deals, axis=0, ddof=1)
    scores = {score: constant(float(mean[at]), count, float(spread[at])) for at, score in enumerate(SCORES)}
    return ScoredRow("chance", True, len(deals), scores)


def _labelled(features: Mapping[str, Sequence[np.ndarray]], labels: Mapping[str, np.ndarray]) -> np.ndarray:
    """Which rows carry a label at all, (N,) bool, once everything is of one length."""
    if not labels or not features or not all(features.values()):
        raise ValueError("clustering needs at least one label and one array of features in each row")
    for what, length in (
        *((f"features {name!r}", len(array)) for name, arrays in features.items() for array in arrays),
        *((f"label {name!r}", len(values)) for name, values in labels.items()),
    ):
        if length != len(next(iter(labels.values()))):
            raise ValueError(
                f"{what} has {length} rows, the others {len(next(iter(labels.values())))}: all features and "
                "labels of one table must be of the same pictures"
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
