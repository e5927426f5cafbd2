"""Several features under the linear protocol: every head and number of labels, seeds, intervals, controls.

All features are asked the same questions of the same test rows after learning from the same training rows,
so differences are paired. A row's seeds are its training rows; where features themselves come in several
runs (an untrained encoder's weights), run and training rows change together.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from derender.evaluation.bootstrap import (
    RESAMPLES,
    ScoredRow,
    constant,
    estimate,
    resamples,
    with_verdicts,
)
from derender.evaluation.feature_rows import Prepared
from derender.evaluation.linear_head import PAPER_HEAD, HeadSettings
from derender.evaluation.linear_probes import HEADS, majority_answers, probe
from derender.evaluation.linear_scores import SCORES, count_scores, linear_scores
from derender.evaluation.linear_task import Rows, Task, choose_rows, task_of
from derender.evaluation.memory import Memory

Progress = Callable[[int, int], object]


@dataclass(frozen=True)
class LinearPart:
    """One head at one number of labels: the features in the order given, then ``majority``."""

    head: str
    count: int
    rows: tuple[ScoredRow, ...]


@dataclass(frozen=True)
class LinearComparison:
    """Features side by side.

    Attributes:
        parts: for every head, every number of labels.
        kind, names: of the task.
        n_test: rows tested, the same everywhere.
        n_dropped: rows without any label.
        seeds: draws of training rows.
    """

    parts: tuple[LinearPart, ...]
    kind: str
    names: tuple[str, ...]
    n_test: int
    n_dropped: int
    seeds: tuple[int, ...]

    def numbers(self) -> dict[str, Any]:
        """Everything as JSON takes it."""
        sizes = {name: getattr(self, name) for name in ("kind", "names", "n_test", "n_dropped", "seeds")}
        parts = [
            {"head": part.head, "labels": part.count, "rows": {row.name: row.numbers() for row in part.rows}}
            for part in self.parts
        ]
        return {**sizes, "parts": parts}


def compare_prepared(
    ready: Prepared,
    counts: Sequence[int],
    seeds: Sequence[int],
    *,
    resample_count: int = RESAMPLES,
    memory: Memory | None = None,
    progress: Progress | None = None,
) -> LinearComparison:
    """Ask rows that were put side by side for all their labels, in their owners' split where there is one."""
    task = task_of(ready.labels)
    return compare_linear(
        ready.features,
        task,
        choose_rows(task, ready.files, counts, seeds, partition=ready.partition),
        seeds,
        controls=ready.controls,
        resample_count=resample_count,
        memory=memory,
        progress=progress,
    )


def compare_linear(
    features: Mapping[str, Sequence[np.ndarray]],
    task: Task,
    rows: Rows,
    seeds: Sequence[int],
    *,
    controls: Collection[str] = (),
    heads: Sequence[str] = HEADS,
    finetuned: Mapping[str, Mapping[int, np.ndarray]] | None = None,
    settings: HeadSettings = PAPER_HEAD,
    resample_count: int = RESAMPLES,
    memory: Memory | None = None,
    progress: Progress | None = None,
) -> LinearComparison:
    """Probe every row of features with every head.

    Args:
        features: by name, one (N, D) array for each run of the same thing; seed s uses run s modulo their
            number.
        task: what is asked.
        rows: who learns and who is tested.
        seeds: (S,) those that drew ``rows``.
        controls: names of the features that learned nothing.
        heads: kinds of probe.
        finetuned: by name and number of labels, (S, T, A) answers of fine-tuned models: a further head.
        settings: of the paper's head.
        resample_count: bootstrap resamples of the test rows.
        memory: where answers are kept.
        progress: called with (probes done, probes in all).
    """
    for name, arrays in features.items():
        for array in arrays:
            if len(array) != len(task):
                raise ValueError(
                    f"features {name!r} have {len(array)} rows, the labels {len(task)}: all features of one "
                    "table must be of the same pictures"
                )
    truth = task.targets[rows.test]
    weights = np.concatenate(list(resamples(len(rows.test), resample_count)))
    total, done, parts = len(heads) * len(rows.train) * len(features), 0, []
    for head in heads:
        for count, own in rows.train.items():
            answers: dict[str, np.ndarray] = {}
            for name, arrays in features.items():
                answers[name] = probe_runs(head, arrays, task, own, rows.test, seeds, settings, memory)
                done += 1
                if progress is not None:
                    progress(done, total)
            parts.append(_part(head, count, answers, task, own, truth, weights, controls))
    for count, own in rows.train.items() if finetuned else ():
        answers = {name: by_count[count] for name, by_count in (finetuned or {}).items()}
        parts.append(_part("fine-tuned", count, answers, task, own, truth, weights, controls))
    dropped = int((~task.known).sum())
    return LinearComparison(tuple(parts), task.kind, task.names, len(rows.test), dropped, tuple(seeds))


def probe_runs(
    head: str,
    arrays: Sequence[np.ndarray],
    task: Task,
    rows: np.ndarray,
    tested: np.ndarray,
    seeds: Sequence[int],
    settings: HeadSettings,
    memory: Memory | None,
) -> np.ndarray:
    """(S, T, A) answers; seeds that share a run are trained together."""
    answers: list[np.ndarray | None] = [None] * len(seeds)
    for run, array in enumerate(arrays):
        mine = [at for at in range(len(seeds)) if at % len(arrays) == run]
        if mine:
            own = [seeds[at] for at in mine]
            found = probe(head, array, task, rows[mine], tested, own, settings=settings, memory=memory)
            for at, answer in zip(mine, found, strict=True):
                answers[at] = answer
    return np.stack([answer for answer in answers if answer is not None])


def _part(
    head: str,
    count: int,
    answers: Mapping[str, np.ndarray],
    task: Task,
    rows: np.ndarray,
    truth: np.ndarray,
    weights: np.ndarray,
    controls: Collection[str],
) -> LinearPart:
    everything = {**answers, "majority": majority_answers(task, rows, len(truth))}
    scored = [
        _row(name, one, truth, task.kind, weights, name in controls or name == "majority")
        for name, one in everything.items()
    ]
    return LinearPart(head, count, with_verdicts(scored))


def _row(
    name: str, answers: np.ndarray, truth: np.ndarray, kind: str, weights: np.ndarray, control: bool
) -> ScoredRow:
    runs = [linear_scores(truth, answer, kind) for answer in answers]
    resampled = np.mean([count_scores(truth, answer, kind, weights) for answer in answers], axis=0)
    scores = {
        score: estimate([getattr(run, score) for run in runs], resampled[:, at])
        for at, score in enumerate(SCORES[:2])
    }
    precision = [run.average_precision for run in runs]
    spread = float(np.std(precision, ddof=1)) if len(precision) > 1 else float("nan")
    scores["average_precision"] = constant(float(np.mean(precision)), len(weights), spread)
    return ScoredRow(name, control, len(runs), scores)
