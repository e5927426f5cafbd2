"""Joint training on held-out images, beside heads on the frozen features it began with, and controls.

The test part of the run's own split is scored; neither training nor the choice of weights saw it. The heads
on frozen features (the paper's, and penalised logistic regression) learn from the very same labels, and so
does the regression on features of an untrained encoder, on principal components and on pixels.
"""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch

from derender.baselines.controls import pca_features, pixel_features, untrained_twin
from derender.data import ImageSet
from derender.evaluation.bootstrap import RESAMPLES, Difference, ScoredRow, difference, numbers_of
from derender.evaluation.finetuning.joint import FinetunedModel, FinetuneTask
from derender.evaluation.linear_probing import LINEAR_COLUMNS, compare_linear
from derender.evaluation.linear_task import Rows, Task
from derender.evaluation.memory import Memory
from derender.evaluation.pixels import component_count
from derender.evaluation.score_table import ScoreTable, scored_table
from derender.features import embed_images, map_batches, model_fingerprint
from derender.inputs import Progress

BOTH = ("accuracy", "balanced_accuracy")


@dataclass(frozen=True)
class FinetuneScores:
    """Held-out scores of ``fine-tuned``, both heads on frozen features, logistic regression on three
    controls, and ``majority``: accuracy, balanced_accuracy, average_precision (0..1, best 1).

    ``versus`` compares the fine-tuned model with the best of the others, by score. ``n_unlabelled`` images of
    the run have none of the labels: rendered, never asked.
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
        versus = {name: asdict(one) for name, one in self.versus.items()}
        return {**vars(self), "rows": numbers_of(self.rows), "versus": versus}

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
        return scored_table(
            caption, "trained on labels", self.rows, LINEAR_COLUMNS, intervals=BOTH, deviations=()
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
    target, seed, kept = task.target, task.config.seed, memory or Memory()
    test = target.split.test[target.asked.known[target.split.test]]
    train = target.split.train[(target.visible[target.split.train] >= 0).any(axis=1)]
    if len(test) < 2:
        raise ValueError(
            f"the test part has {len(test)} images with a label, two are needed to score: "
            "bring more images, or set a larger test share in split="
        )

    def answered() -> dict[str, np.ndarray]:
        parts = map_batches(tuned.predict, tuned, task.images[test], batch_size=256)
        return {"answers": torch.cat(parts).cpu().numpy()}

    inputs = {"weights": model_fingerprint(tuned), "kind": target.asked.kind, "images": task.images[test]}
    answers = kept.recall("finetuned-answers", inputs, answered)["answers"]
    start = (task.start if task.start is not None else task.build().model).to(tuned.device)
    features = _features(start, task, np.concatenate([train, test]), kept)
    count, runs = len(train), {name: [values] for name, values in features.items()}
    rows = Rows(np.arange(count, count + len(test)), {count: np.arange(count)[None]})
    asked = Task(target.asked.kind, target.asked.names, target.asked.targets[np.concatenate([train, test])])
    how: dict[str, Any] = {"resample_count": resample_count, "memory": kept}
    tuned_answers = {"fine-tuned": {count: answers[None]}}
    logistic, joint = compare_linear(
        runs, asked, rows, (seed,), heads=("logistic",), finetuned=tuned_answers, progress=progress, **how
    ).parts
    paper = compare_linear({"frozen": runs["frozen"]}, asked, rows, (seed,), heads=("linear",), **how).parts[
        0
    ]
    ours, majority = joint.rows
    frozen, *controls = logistic.rows[: len(features)]
    named = {"frozen, logistic": frozen, "frozen, paper's head": paper.rows[0]}
    named |= {f"{row.name}, logistic": row for row in controls} | {"majority": majority}
    others = {name: row.scores for name, row in named.items()}
    rivals = {score: {name: scores[score] for name, scores in others.items()} for score in BOTH}
    controls = (ScoredRow(name, True, 1, scores) for name, scores in others.items())
    return FinetuneScores(
        (ScoredRow("fine-tuned", False, 1, ours.scores), *controls),
        {score: difference(ours.scores[score], rivals[score]) for score in BOTH},
        asked.kind,
        asked.names,
        count,
        len(test),
        int((~target.asked.known).sum()),
    )


def _features(start: Any, task: FinetuneTask, rows: np.ndarray, kept: Memory) -> dict[str, np.ndarray]:
    """(R, D) of some of the task's images: codes that training began with, and three that learned nothing."""

    def codes(model: Any) -> np.ndarray:
        inputs = {"weights": model_fingerprint(model), "images": task.images[rows]}
        found = kept.recall("embedding", inputs, lambda: embed_images(model, task.images[rows]))
        return np.concatenate([found[name] for name in task.config.target.factors], axis=1)

    shown, fitted = (
        ImageSet(task.images[some], tuple(map(str, some.tolist())))
        for some in (rows, task.target.split.train)
    )
    components = component_count(len(fitted))
    inputs = {"images": shown.images, "components": components, "fit_on": fitted.images}
    pca = kept.recall(
        "pca", inputs, lambda: dict(pca_features(shown, components=components, fit_on=fitted).factors)
    )
    return {
        "frozen": codes(start),
        "untrained encoder": codes(untrained_twin(start, task.config.seed)),
        f"PCA ({components})": pca["pca"],
        "pixels": pixel_features(shown).concatenate(),
    }
