"""The question of a linear probe: targets from label columns, rows to learn from and to be tested on, scores.

Columns of two values each are asked together, each by a yes or no of its own (multi-label, as CelebA's 40
attributes). One column of more values is asked as a choice of one (multi-class). The test rows are fixed: no
seed, no number of labels and no choice of a penalty ever touches them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from derender.data import split_indices
from derender.evaluation.options import COUNTS
from derender.features import missing


@dataclass(frozen=True)
class Task:
    """Targets, (N, A) int8 in -1 (unknown), 0, 1, of N rows.

    Of kind "labels" (``names``, yes or no, each apart), or "classes" (one of several): one-hot, all -1 where
    unknown.
    """

    kind: str
    names: tuple[str, ...]
    targets: np.ndarray

    def __len__(self) -> int:
        return len(self.targets)

    @property
    def known(self) -> np.ndarray:
        """(N,) bool: rows that carry a label at all."""
        return np.any(self.targets >= 0, axis=1)

    def select(self, rows: np.ndarray) -> "Task":
        """The task of some rows."""
        return Task(self.kind, self.names, self.targets[rows])


@dataclass(frozen=True)
class Rows:
    """(T,) rows tested; by number of labels, (S, number) rows learned from, smaller sets within larger."""

    test: np.ndarray
    train: Mapping[int, np.ndarray]


def task_of(labels: Mapping[str, np.ndarray]) -> Task:
    """The task that label columns set: several of two values each, or one; no value has a single row."""
    if not labels:
        raise ValueError("a linear probe needs at least one label column")
    columns = {name: _column(np.asarray(values), name) for name, values in labels.items()}
    many = [name for name, (values, _) in columns.items() if len(values) > 2]
    if not many:
        targets = np.column_stack([numbers for _, numbers in columns.values()])
        return Task("labels", tuple(columns), targets.astype(np.int8))
    values, numbers = columns[many[0]]
    if len(columns) > 1:
        what = f"label {many[0]!r} has {len(values)} classes and cannot be asked together with others"
        raise ValueError(f"{what}: name it alone, or only labels of two values")
    targets = (numbers[:, None] == np.arange(len(values))).astype(np.int8)
    targets[numbers < 0] = -1
    return Task("classes", tuple(map(str, values)), targets)


def choose_rows(
    task: Task, files: Sequence[str], counts: Sequence[int] = COUNTS, seeds: Sequence[int] = (0, 1, 2, 3, 4),
    **how: Any,
) -> Rows:  # fmt: skip
    """Test rows and, for every seed, nested training rows: ``counts`` of those of ``divide_rows``."""
    pool, test = divide_rows(task, files, **how)
    if not len(seeds):
        raise ValueError("a linear probe needs at least one seed")
    if tuple(counts) == COUNTS:
        counts = [count for count in COUNTS if count <= len(pool)] or [len(pool)]
    if not len(counts) or min(counts) < 2 or max(counts) > len(pool) or len(test) < 2:
        got = f"{len(pool)} can be learned from and {len(test)} are tested; counts must lie in 2..{len(pool)}"
        raise ValueError(f"asked to learn from {', '.join(map(str, counts)) or 'no'} labelled rows: {got}")
    orders = [np.random.default_rng(seed).permutation(pool) for seed in seeds]
    return Rows(test, {count: np.stack([order[:count] for order in orders]) for count in counts})


def divide_rows(
    task: Task, files: Sequence[str], *, test_fraction: float = 0.5, partition: np.ndarray | None = None,
    groups: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Labelled rows that may be learned from, and those that are tested.

    Args:
        task: rows without a label are left out.
        files: names of the N rows; the split goes by a hash of these.
        test_fraction: share of the rows that is tested.
        partition: the owners' split; where it has "test" rows, these are tested and no others.
        groups: (N,) labels that must not lie on both sides, such as identities; rows without one stand alone.
    """
    known, tested = task.known, np.asarray(partition) == "test"
    if tested.any():
        return np.flatnonzero(known & ~tested), np.flatnonzero(known & tested)
    split = split_indices(files, (1 - test_fraction, 0.0, test_fraction), groups=groups)
    learn, test = split.train[known[split.train]], split.test[known[split.test]]
    if groups is not None and task.kind == "classes" and len(learn) and len(test):
        shown, asked = (np.any(task.targets[rows] > 0, axis=0) for rows in (learn, test))
        if not (shown & asked).any():
            what = f"none of the {int(asked.sum())} classes tested is learned from"
            raise ValueError(f"{what}: these groups hold whole classes; choose others, or none")
    return learn, test


def _column(values: np.ndarray, name: str) -> tuple[list[Any], np.ndarray]:
    """The distinct values of a column, sorted, and (N,) their numbers, -1 where missing."""
    known, numbers = ~missing(values), np.full(len(values), -1, np.int64)
    distinct, numbers[known], counts = np.unique(values[known], return_inverse=True, return_counts=True)
    if len(distinct) < 2:
        have = f"the {int(known.sum())} labelled rows of {name!r} have {len(distinct)}"
        raise ValueError(f"a linear probe needs at least two classes, {have}: choose another label column")
    if counts.min() < 2:
        what = f"class {distinct.tolist()[counts.argmin()]!r} of label {name!r} has one row"
        raise ValueError(f"{what}, to learn from or to test: leave it out (min_count=2), or choose another")
    return distinct.tolist(), numbers


@dataclass(frozen=True)
class LinearScores:
    """How right answers are, 0..1, best 1.

    Share of right answers (at threshold 0.5, or of the likeliest class) and its mean over the rows of each
    value or class. Then area under precision over recall of each.
    """

    accuracy: float
    balanced_accuracy: float
    average_precision: float


def linear_scores(targets: np.ndarray, probabilities: np.ndarray, kind: str) -> LinearScores:
    """Score (T, A) probabilities against (T, A) targets in -1 (unknown), 0, 1; one-hot for classes.

    Values and classes that no row has do not count.
    """
    accuracy, balanced = count_scores(targets, probabilities, kind, np.ones((1, len(targets)), np.float32))[0]
    return LinearScores(float(accuracy), float(balanced), mean_precision(targets, probabilities))


def mean_precision(targets: np.ndarray, probabilities: np.ndarray) -> float:
    """Average precision of ``linear_scores``, 0 to 1, best 1; NaN where no row is positive."""
    from sklearn.metrics import average_precision_score

    columns = [(t, t >= 0, p) for t, p in zip(targets.T, probabilities.T, strict=True) if (t == 1).any()]
    precisions = [average_precision_score(truth[known], answer[known]) for truth, known, answer in columns]
    return float(np.mean(precisions)) if precisions else float("nan")


def count_scores(targets: np.ndarray, answers: np.ndarray, kind: str, weights: np.ndarray) -> np.ndarray:
    """Accuracy and balanced accuracy of ``linear_scores``, (B, 2), where (B, T) ``weights`` draw the rows."""
    if targets.shape != answers.shape:
        raise ValueError(f"targets {targets.shape} and probabilities {answers.shape} must be alike")
    positive, negative = (targets == 1).astype(np.float32), (targets == 0).astype(np.float32)
    if kind == "classes":
        right = answers.argmax(axis=1) == targets.argmax(axis=1)
        hits, sizes = weights @ (positive * right[:, None]), weights @ positive
        balanced = np.nanmean(_share(hits, sizes), axis=1)
        return np.column_stack((hits.sum(axis=1) / sizes.sum(axis=1), balanced))
    answered = answers > 0.5
    yes, no = weights @ (positive * answered), weights @ (negative * ~answered)
    positives, negatives = weights @ positive, weights @ negative
    recalls = np.stack((_share(yes, positives), _share(no, negatives)))
    accuracy = np.nanmean(_share(yes + no, positives + negatives), axis=1)
    return np.column_stack((accuracy, np.nanmean(recalls, axis=0).mean(axis=1)))


def _share(hits: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    return np.divide(hits, sizes, out=np.full_like(hits, np.nan), where=sizes > 0)
