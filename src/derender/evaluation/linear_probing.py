"""Linear protocol: how much does a linear head learn from features, given few labels?

Source: Klinghoffer et al., ECCV 2022, Sec. 4.4. All features are asked the same questions of the same test
    rows after learning from the same training rows, so differences are paired. A row's seeds are its
    training rows; where features themselves come in several runs (an untrained encoder's weights), run and
    training rows change together.

Scores are averaged over labels (or classes). Accuracy rewards the majority's answer (0.80 on CelebA):
balanced accuracy is 0.5 for any constant answer (one over the number of classes), and average precision,
which needs no threshold, is the label's share for answers that know nothing.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from sklearn.metrics import average_precision_score

from derender.data import ImageSet
from derender.evaluation.bootstrap import RESAMPLES, ScoredRow, constant, estimate, resamples, with_verdicts
from derender.evaluation.controls import image_notes, subject_and_controls
from derender.evaluation.feature_rows import (
    DEFAULT_FACTORS,
    FeatureSource,
    Prepared,
    StageProgress,
    aligned,
    chosen_labels,
    is_model,
    prepare,
    sized,
    stage,
)
from derender.evaluation.linear_finetune import finetuned_answers
from derender.evaluation.linear_head import PAPER_HEAD, HeadSettings
from derender.evaluation.linear_probes import HEADS, check_head, majority_answers, probe_runs
from derender.evaluation.linear_task import Rows, Task, choose_rows, task_of
from derender.evaluation.memory import Memory, memory_in
from derender.evaluation.score_table import Column, Scores, ScoreTable, scored_table, verdict_table
from derender.inputs import Progress, as_model

LINEAR_COLUMNS = {
    "accuracy": Column("accuracy", "high", note="share of right answers at threshold 0.5, 0 to 1"),
    "balanced_accuracy": Column("balanced", "high", note="mean recall over values or classes, 0 to 1"),
    "average_precision": Column("AP", "high", note="average precision, 0 to 1"),
}
PROBE_NAMES = {
    "linear": "the paper's head, frozen features",
    "centred": "the paper's head, frozen features, centred",
    "logistic": "penalised logistic regression",
    "k-NN": "10 nearest neighbours",
    "fine-tuned": "the paper's head, encoders trained too",
}


def linear(
    features: FeatureSource,
    label: str | Sequence[str] | None = None,
    *,
    images: ImageSet | str | Path | None = None,
    attributes: bool = False,
    factors: Sequence[str] | None = DEFAULT_FACTORS,
    counts: Sequence[int] = (100, 500, 1_000),
    heads: Sequence[str] = HEADS,
    seeds: int = 5,
    test_fraction: float = 0.5,
    groups: str | None = None,
    finetune: bool = False,
    epochs: int = 100,
    min_count: int = 1,
    max_count: int | None = None,
    untrained_seeds: int = 5,
    whiten_on: ImageSet | str | Path | None = None,
    resamples: int = RESAMPLES,
    seed: int = 0,
    dataset: str = "auto",
    limit: int | None = None,
    device: str = "auto",
    cache: Memory | str | Path | None = None,
    progress: StageProgress | None = None,
) -> Scores:
    """Probe features with linear heads that learn from few labels, beside controls; every score is best at 1.

    Args:
        features: a feature table or its ``.parquet`` file; a model or its name, with ``images``.
        label: one column of classes, or columns of two values.
        images: a data set or its address: of the model, and of the controls.
        attributes: probe every yes/no label instead of ``label``.
        factors: features to use, side by side; None means all.
        counts: numbers of labelled rows to learn from.
        heads: probes: "linear" (the paper's), "centred", "logistic", "k-NN".
        seeds: random training subsets.
        test_fraction: share of the rows that is tested.
        groups: a label whose rows stay on one side of the split, as identity.
        finetune: also train the model's encoders with the head.
        epochs: of the paper's head.
        min_count, max_count: leave out classes of fewer rows; use at most so many rows of a class.
        untrained_seeds: untrained encoders to average over.
        whiten_on, resamples, dataset, limit, device, cache, progress: see ``cluster``.
        seed: the first seed of training subsets and untrained encoders; of resamples.

    Raises:
        ValueError: labels, factors, counts or images do not fit.
    """
    for head in heads:
        check_head(head)
    if finetune and not is_model(features):
        raise ValueError("finetune trains the encoders: give a model and images")
    memory = memory_in(cache)
    read = sized(images, dataset=dataset, limit=limit, progress=progress)
    rows = subject_and_controls(
        features, read, factors, range(seed, seed + untrained_seeds), memory=memory, device=device,
        whiten_on=whiten_on, progress=progress,
    )  # fmt: skip
    names, left_out = chosen_labels(rows[0].tables[0], label, attributes, least=2)
    kept = [groups] if groups else []
    ready = prepare(rows, names, min_count=min_count, max_count=max_count, keep=kept)
    task, subsets = task_of(ready.labels), range(seed, seed + seeds)
    split = choose_rows(
        task, ready.files, counts, subsets, test_fraction=test_fraction, partition=ready.partition,
        groups=ready.kept[groups] if groups else None,
    )  # fmt: skip
    settings, tuned = HeadSettings(epochs=epochs), None
    if finetune:
        assert read is not None and is_model(features)
        tuned = finetuned_answers(
            {rows[0].name: [as_model(features, device=device)]},
            lambda size: aligned(read.at(size), ready.files).images,
            ready, task, split, subsets, factors, settings, memory, progress,
        )  # fmt: skip
    found = compare_linear(
        ready.features, task, split, subsets, controls=ready.controls, heads=heads, finetuned=tuned,
        settings=settings, resample_count=resamples, memory=memory,
        progress=stage(progress, "probing", "probes"),
    )  # fmt: skip
    notes = [*image_notes(read), *left_out, memory.summary()]
    return Scores(linear_tables(found), {**found.numbers(), "labels": names}, notes)


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
                    "table must be of the same images"
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


def linear_tables(found: LinearComparison) -> list[ScoreTable]:
    """Every head at every number of labels, each with its differences to the strongest control."""
    tables = []
    for part in found.parts:
        caption = f"{part.count:,} labelled rows, {part.head}: above the strongest control?"
        tables += [linear_part_table(found, part), verdict_table(part.rows, LINEAR_COLUMNS, caption)]
    return tables


def linear_part_table(found: LinearComparison, part: LinearPart) -> ScoreTable:
    """One head at one number of labels: a row for each feature and control."""
    what = asked_labels(found.kind, len(found.names))
    caption = (
        f"{part.count:,} labelled rows, {PROBE_NAMES.get(part.head, part.head)}: {found.n_test:,} rows "
        f"tested, {what}, {len(found.seeds)} seeds"
    )
    if found.n_dropped:
        caption += f"; {found.n_dropped:,} rows without label left out"
    return scored_table(caption, "features", part.rows, LINEAR_COLUMNS)


def asked_labels(kind: str, count: int) -> str:
    """The labels of a task in words."""
    return f"{count} classes" if kind == "classes" else f"mean of {count} yes/no labels"


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
    deviation = float(np.std(precision, ddof=1)) if len(precision) > 1 else float("nan")
    scores["average_precision"] = constant(float(np.mean(precision)), len(weights), deviation)
    return ScoredRow(name, control, len(runs), scores)


SCORES = ("accuracy", "balanced_accuracy", "average_precision")


@dataclass(frozen=True)
class LinearScores:
    """How right answers are; all 0..1, best 1.

    Attributes:
        accuracy: share of right answers, at threshold 0.5 for each label, or of the likeliest class.
        balanced_accuracy: mean of the shares of right answers among the rows of each value or class.
        average_precision: area under precision over recall, of the value 1 or of each class against the rest.
    """

    accuracy: float
    balanced_accuracy: float
    average_precision: float


def linear_scores(targets: np.ndarray, probabilities: np.ndarray, kind: str) -> LinearScores:
    """Score (T, A) probabilities against (T, A) targets in -1 (unknown), 0, 1; one-hot for classes.

    Values and classes that no row has do not count.
    """
    accuracy, balanced = count_scores(targets, probabilities, kind, np.ones((1, len(targets)), np.float32))[0]
    precisions = []
    for truth, answer in zip(targets.T, probabilities.T, strict=True):
        rows = truth >= 0
        if (truth == 1).any():
            precisions.append(average_precision_score(truth[rows], answer[rows]))
    precision = float(np.mean(precisions)) if precisions else float("nan")
    return LinearScores(float(accuracy), float(balanced), precision)


def count_scores(
    targets: np.ndarray, probabilities: np.ndarray, kind: str, weights: np.ndarray
) -> np.ndarray:
    """Accuracy and balanced accuracy on resamples: (B, 2).

    Args:
        targets, probabilities: (T, A), see ``linear_scores``.
        kind: "labels" or "classes".
        weights: (B, T) how often each row is drawn.
    """
    if targets.shape != probabilities.shape:
        raise ValueError(f"targets {targets.shape} and probabilities {probabilities.shape} must be alike")
    positive, negative = (targets == 1).astype(np.float32), (targets == 0).astype(np.float32)
    if kind == "classes":
        right = probabilities.argmax(axis=1) == targets.argmax(axis=1)
        hits, sizes = weights @ (positive * right[:, None]), weights @ positive
        return np.column_stack((hits.sum(axis=1) / sizes.sum(axis=1), _mean(hits, sizes)))
    answered = probabilities > 0.5
    yes, no = weights @ (positive * answered), weights @ (negative * ~answered)
    positives, negatives = weights @ positive, weights @ negative
    recalls = np.stack((_share(yes, positives), _share(no, negatives)))
    balanced = np.nanmean(recalls, axis=0).mean(axis=1)
    return np.column_stack((_mean(yes + no, positives + negatives), balanced))


def _share(hits: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    return np.divide(hits, sizes, out=np.full_like(hits, np.nan), where=sizes > 0)


def _mean(hits: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Mean share over those labels or classes that have rows."""
    return np.nanmean(_share(hits, sizes), axis=1)
