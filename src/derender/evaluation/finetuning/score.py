"""Joint training on held-out images, beside heads on the frozen features it began with, and controls.

The test part of the run's own split is scored; neither training nor the choice of weights saw it. The heads
on frozen features (the paper's, and penalised logistic regression) learn from the very same labels, and so
does the regression on features of an untrained encoder, on principal components and on pixels.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from derender.baselines.controls import pca_features, pixel_features, untrained_twin
from derender.data import ImageSet
from derender.evaluation.bootstrap import RESAMPLES, Difference, ScoredRow, difference
from derender.evaluation.finetuning.joint import FinetunedModel, FinetuneTask
from derender.evaluation.linear_probing import LINEAR_COLUMNS, compare_linear
from derender.evaluation.linear_task import Rows, Task
from derender.evaluation.memory import Memory
from derender.evaluation.score_table import ScoreTable, scored_table
from derender.features import embed_images, map_batches, model_fingerprint
from derender.inputs import Progress

JOINT, LOGISTIC, PAPER_HEAD, MAJORITY = "fine-tuned", "frozen, logistic", "frozen, paper's head", "majority"


@dataclass(frozen=True)
class FinetuneScores:
    """Held-out scores.

    Attributes:
        rows: ``fine-tuned``, both heads on frozen features, logistic regression on an untrained encoder's
            features, on principal components of the training part, and on pixels, ``majority``; accuracy,
            balanced_accuracy and average_precision (0..1, best 1) of each, the first two with intervals.
        versus: by score, the fine-tuned model against the best of the others.
        kind, names: of the task.
        n_train, n_test: labelled images learned from, and tested.
        n_unlabelled: images of the run without any of the labels: rendered, never asked.
    """

    rows: tuple[ScoredRow, ...]
    versus: dict[str, Difference]
    kind: str
    names: tuple[str, ...]
    n_train: int
    n_test: int
    n_unlabelled: int

    def numbers(self) -> dict[str, Any]:
        """Everything as JSON takes it."""
        versus = {
            name: {part: getattr(one, part) for part in ("rival", "value", "low", "high", "above")}
            for name, one in self.versus.items()
        }
        sizes = {name: getattr(self, name) for name in ("kind", "names", "n_train", "n_test", "n_unlabelled")}
        return {**sizes, "rows": {row.name: row.numbers() for row in self.rows}, "versus": versus}

    def table(self, began: str) -> ScoreTable:
        """A row each; ``began`` names the model whose frozen features the heads take."""
        count = len(self.names)
        task = f"{count} classes" if self.kind == "classes" else f"mean of {count} yes/no labels"
        caption = (
            f"{task}: {self.n_train:,} labelled images learned, {self.n_test:,} held out; frozen features "
            f"of {began}"
        )
        if self.n_unlabelled:
            caption += f"; {self.n_unlabelled:,} images without label never asked"
        both = ("accuracy", "balanced_accuracy")
        return scored_table(
            caption, "trained on labels", self.rows, LINEAR_COLUMNS, intervals=both, deviations=()
        )


def score_finetuned(
    tuned: FinetunedModel,
    task: FinetuneTask,
    *,
    resample_count: int = RESAMPLES,
    memory: Memory | None = None,
    progress: Progress | None = None,
) -> FinetuneScores:
    """Score a trained model on the task's test part; what took long is kept in ``memory``.

    Raises:
        ValueError: no tested image has a label.
    """
    target = task.target
    test = target.split.test[target.asked.known[target.split.test]]
    train = target.split.train[(target.visible[target.split.train] >= 0).any(axis=1)]
    if len(test) < 2:
        raise ValueError(
            f"the test part has {len(test)} images with a label, two are needed to score: "
            "bring more images, or set a larger test share in split="
        )
    memory, rows = memory or Memory(), np.concatenate([train, test])

    def answered() -> dict[str, np.ndarray]:
        parts = map_batches(
            lambda batch: tuned.predict(batch).cpu().numpy(), tuned, task.images[test], batch_size=256
        )
        return {"answers": np.concatenate(parts)}

    inputs = {"weights": model_fingerprint(tuned), "kind": target.asked.kind, "images": task.images[test]}
    answers = memory.recall("finetuned-answers", inputs, answered)["answers"]
    start = (task.start if task.start is not None else task.build().model).to(tuned.device)
    frozen = _codes(start, task, rows, memory)
    asked = Task(target.asked.kind, target.asked.names, target.asked.targets[rows])
    count, seed = len(train), task.config.seed
    who = Rows(np.arange(count, len(rows)), {count: np.arange(count)[None]})
    found = compare_linear(
        {LOGISTIC: [frozen]},
        asked,
        who,
        (seed,),
        heads=("logistic", "linear"),
        finetuned={JOINT: {count: answers[None]}},
        resample_count=resample_count,
        memory=memory,
        progress=progress,
    )
    by_head = {part.head: part.rows for part in found.parts}
    controls = _controls(start, task, rows, memory)
    known = compare_linear(
        {name: [values] for name, values in controls.items()},
        asked, who, (seed,), heads=("logistic",), resample_count=resample_count, memory=memory,
    ).parts[0].rows  # fmt: skip
    joint, majority = by_head["fine-tuned"]
    heads = [
        ScoredRow(name, True, 1, by_head[head][0].scores)
        for name, head in ((LOGISTIC, "logistic"), (PAPER_HEAD, "linear"))
    ]
    ours = ScoredRow(JOINT, False, 1, joint.scores)
    quiet = [ScoredRow(f"{row.name}, logistic", True, 1, row.scores) for row in known[: len(controls)]]
    others = (*heads, *quiet, ScoredRow(MAJORITY, True, 1, majority.scores))
    versus = {
        name: difference(ours.scores[name], {row.name: row.scores[name] for row in others})
        for name in ("accuracy", "balanced_accuracy")
    }
    unlabelled = int((~target.asked.known).sum())
    return FinetuneScores((ours, *others), versus, asked.kind, asked.names, count, len(test), unlabelled)


def _codes(model: Any, task: FinetuneTask, rows: np.ndarray, memory: Memory) -> np.ndarray:
    """(R, D) features of some rows of the task's images, those that the head reads side by side."""
    inputs = {"weights": model_fingerprint(model), "images": task.images[rows]}
    codes = memory.recall("embedding", inputs, lambda: embed_images(model, task.images[rows]))
    return np.concatenate([codes[name] for name in task.config.target.factors], axis=1)


def _controls(start: Any, task: FinetuneTask, rows: np.ndarray, memory: Memory) -> dict[str, np.ndarray]:
    """(R, D) features that learned nothing, of some rows of the task's images."""
    twin, train = untrained_twin(start, task.config.seed), task.target.split.train
    shown, fitted = (ImageSet(task.images[some], tuple(map(str, some.tolist()))) for some in (rows, train))
    components = max(1, min(64, len(fitted) // 4))
    pca = memory.recall(
        "pca",
        {"images": shown.images, "components": components, "fit_on": fitted.images},
        lambda: dict(pca_features(shown, components=components, fit_on=fitted).factors),
    )["pca"]
    return {
        "untrained encoder": _codes(twin, task, rows, memory),
        f"PCA ({components})": pca,
        "pixels": pixel_features(shown).concatenate(),
    }
