"""Linear protocol: how much does a linear head learn from features, given few labels?

Source: Klinghoffer et al., ECCV 2022, Sec. 4.4. All features are tested on the same rows after learning from
the same training rows, so differences are paired. A row's seeds are its training rows; where features come in
several runs (an untrained encoder's weights), run and training rows change together.

Scores are averaged over labels (or classes). Accuracy rewards the majority's answer (0.80 on CelebA):
balanced accuracy is 0.5 for any constant answer (one over the number of classes). Average precision needs no
threshold, and is the label's share for answers that know nothing.

Table 2's "Finetune" trains the encoders, too, of a baseline the whole network, with the head's Adam 2e-4, 100
epochs and batches of 64. A ResNet-18 with fresh weights is the paper's supervised row, an untrained model the
control. Controls without an encoder are the head alone. Leaves out the rendering objective beside the task
(finetuning.py).
"""

import copy
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import nn

from derender.baselines.controls import untrained_twin
from derender.baselines.supervised import fresh_resnet18
from derender.data import as_float
from derender.evaluation import bootstrap, feature_rows
from derender.evaluation import linear_probes as probes
from derender.evaluation.linear_task import Rows, Task, choose_rows, count_scores, mean_precision, task_of
from derender.evaluation.memory import Memory
from derender.evaluation.options import COUNTS, Options
from derender.evaluation.score_table import Column, Scores, ScoreTable, judged_tables
from derender.features import model_fingerprint, named
from derender.inputs import Progress, device_named
from derender.model import Derenderer

LINEAR_COLUMNS = {
    "accuracy": Column("accuracy", "high", note="share of right answers at threshold 0.5, 0 to 1"),
    "balanced_accuracy": Column("balanced", "high", note="mean recall over values or classes, 0 to 1"),
    "average_precision": Column("AP", "high", note="average precision, 0 to 1"),
}
BOTH = ("accuracy", "balanced_accuracy")  # those that have an interval
FINETUNED, SUPERVISED = "fine-tuned", "ResNet-18, supervised"
PROBE_NAMES = {**probes.PROBES, FINETUNED: "the paper's head, encoders trained too"}


def linear(
    features: feature_rows.FeatureSource, label: str | Sequence[str] | None = None, *,
    attributes: bool = False, counts: Sequence[int] = COUNTS, heads: Sequence[str] = probes.HEADS,
    seeds: int = 5, test_fraction: float = 0.5, groups: str | None = None, finetune: bool = False,
    epochs: int = 100, min_count: int = 1, max_count: int | None = None, untrained_seeds: int = 5,
    **options: Any,
) -> Scores:  # fmt: skip
    """Probe features with linear heads that learn from few labels, beside controls; every score is best at 1.

    Args:
        features: a feature table or its ``.parquet`` file; a model or its name, with ``images``.
        label: one column of classes, or columns of two values.
        attributes: probe every yes/no label instead of ``label``.
        counts: numbers of labelled rows to learn from; of the default ones those that there are.
        heads: probes: "linear" (the paper's), "centred", "logistic", "k-NN".
        seeds: random training subsets.
        test_fraction: share of the rows that is tested.
        groups: a label whose rows stay on one side of the split, as identity.
        finetune: also train the model's encoders with the head.
        epochs: of the paper's head.
        min_count, max_count: leave out classes of fewer rows; use at most so many rows of a class.
        untrained_seeds: number of untrained encoders to average over.
        options: images, factors, seed, resamples, cache, ...: the fields of ``Options``.

    Raises:
        ValueError: labels, factors, counts or images do not fit.
    """
    heads = (heads,) if isinstance(heads, str) else heads
    counts = (counts,) if isinstance(counts, int) else counts
    for head in heads:
        named(probes.PROBES, head, "head")
    if finetune and not feature_rows.is_model(features):
        raise ValueError("finetune trains the encoders: give a model and images")
    how = Options.of(options, untrained_seeds=untrained_seeds)
    rows = feature_rows.subject_and_controls(features, how)
    names, left_out = feature_rows.chosen_labels(rows[0].tables[0], label, attributes, least=2)
    ready = feature_rows.prepare(rows, names, min_count=min_count, max_count=max_count)
    result = compare_prepared(
        ready, counts, how.seeds(seeds), how, heads=heads, settings=probes.HeadSettings(epochs=epochs),
        models={rows[0].name: [features]} if finetune and feature_rows.is_model(features) else {},
        test_fraction=test_fraction, groups=ready.table.label(groups) if groups else None,
    )  # fmt: skip
    tables, notes = linear_tables(result), [*how.notes, *left_out, how.memory.summary()]
    if ready.n_dropped:
        most = max_count or "all"
        notes.insert(0, f"{ready.n_dropped:,} rows beyond {min_count} to {most} rows of a class left out")
        result = replace(result, n_dropped=result.n_dropped + ready.n_dropped)
    return Scores(tables, {**result.numbers(), "labels": names}, notes)


@dataclass(frozen=True)
class LinearPart:
    """One head at one number of labels: the features in the order given, then ``majority``."""

    head: str
    count: int
    rows: tuple[bootstrap.ScoredRow, ...]


@dataclass(frozen=True)
class LinearComparison:
    """For every head and number of labels, features side by side; the task's kind and names.

    ``n_test`` rows are tested, the same everywhere; ``n_dropped`` have no label; ``seeds`` drew training
    rows.
    """

    parts: tuple[LinearPart, ...]
    kind: str
    names: tuple[str, ...]
    n_test: int
    n_dropped: int
    seeds: tuple[int, ...]

    def numbers(self) -> dict[str, Any]:
        """Everything as JSON takes it."""
        parts = [
            {"head": part.head, "labels": part.count, "rows": bootstrap.numbers_of(part.rows)}
            for part in self.parts
        ]
        return {**vars(self), "parts": parts}


def compare_prepared(
    ready: feature_rows.Prepared, counts: Sequence[int], seeds: Sequence[int], options: Options, *,
    heads: Sequence[str] = probes.HEADS, settings: probes.HeadSettings = probes.PAPER_HEAD,
    models: Mapping[str, Sequence[feature_rows.ModelSource]] | None = None, supervised: bool = False,
    **rows: Any,
) -> LinearComparison:  # fmt: skip
    """Ask rows that were put side by side for all their labels, in their owners' split where there is one.

    ``models``, by name, are trained together with the head; with ``supervised`` a ResNet-18, too. Seed s
    trains run s of a model modulo their number. ``rows`` are test_fraction and groups of ``choose_rows``.
    """
    task = task_of(ready.labels)
    split = choose_rows(task, counts=counts, seeds=seeds, **ready.split, **rows)

    def learned(model: Any, count: int, at: int, what: str) -> np.ndarray:
        training, images = split.train[count][at], options.at(model.image_size, ready.table.files).images
        ours = isinstance(model, Derenderer)
        chosen = list(options.chosen or (one.name for one in model.factors)) if ours else list(model.chosen)
        inputs = {
            "weights": model_fingerprint(model), "images": images, "targets": task.targets, "kind": task.kind,
            "rows": training, "tested": split.test, "seed": seeds[at], "factors": chosen,
            "settings": settings.model_dump(),
        }  # fmt: skip
        progress = options.stage(f"fine-tuning {what}, {count:,} labels, seed {seeds[at]}", "epochs")
        fit = partial(finetune, model, images, task, training, split.test, factors=chosen, settings=settings)
        return options.memory.recall_one("finetuned", inputs, partial(fit, seed=seeds[at], progress=progress))

    opened = partial(feature_rows.opened, device=options.device)
    trained = {name: list(map(opened, runs)) for name, runs in (models or {}).items()}
    if ours := [run for runs in trained.values() for run in runs if isinstance(run, Derenderer)]:
        trained[feature_rows.UNTRAINED] = [untrained_twin(ours[0], seed) for seed in seeds]
    if supervised:
        size, device = next(iter(trained.values()))[0].image_size, device_named(options.device)
        trained[SUPERVISED] = [fresh_resnet18(size, seed).to(device) for seed in seeds]
    tuned: dict[str, dict[int, np.ndarray]] = {name: {} for name in trained}
    for name, runs in trained.items():
        for count in split.train:
            each = [learned(runs[at % len(runs)], count, at, name) for at in range(len(seeds))]
            tuned[name][count] = np.stack(each)
    again: dict[str, Any] = {"settings": settings, "memory": options.memory}
    for name in ready.controls if models else ():
        if not name.startswith(feature_rows.UNTRAINED):  # no encoder to train: the answers of the head alone
            alone = partial(probes.probe_runs, "linear", ready.features[name], task, **again)
            tuned[name] = {count: alone(own, split.test, seeds) for count, own in split.train.items()}
    return compare_linear(
        ready.features, task, split, seeds, controls=ready.controls, heads=heads, finetuned=tuned,
        resample_count=options.resamples, progress=options.stage("probing", "probes"), **again,
    )  # fmt: skip


def compare_linear(
    features: Mapping[str, Sequence[np.ndarray]], task: Task, rows: Rows, seeds: Sequence[int], *,
    controls: Collection[str] = (), heads: Sequence[str] = probes.HEADS,
    finetuned: Mapping[str, Mapping[int, np.ndarray]] | None = None,
    settings: probes.HeadSettings = probes.PAPER_HEAD, resample_count: int = bootstrap.RESAMPLES,
    memory: Memory | None = None, progress: Progress | None = None,
) -> LinearComparison:  # fmt: skip
    """Probe every row of features with every head.

    ``features`` holds by name one (N, D) array for each run of the same thing; seed s uses run s modulo their
    number. ``rows`` were drawn by the (S,) ``seeds``; ``controls`` are names of features that learned
    nothing. ``finetuned``, by name and number of labels (S, T, A) answers of fine-tuned models, are a further
    head. ``progress`` is called with (probes done, probes in all).
    """
    feature_rows.check_lengths(features, len(task))
    truth = task.targets[rows.test]
    weights = bootstrap.once_and_resampled(len(rows.test), resample_count, seeds[0])

    def scored(name: str, answers: np.ndarray) -> bootstrap.ScoredRow:
        """Scores of (S, T, A) answers; average precision has no interval."""
        counted = np.stack([count_scores(truth, answer, task.kind, weights) for answer in answers])
        row = bootstrap.scored_row(name, name in {*controls, "majority"}, BOTH, counted)
        precision = bootstrap.constant([mean_precision(truth, answer) for answer in answers], resample_count)
        return replace(row, scores={**row.scores, "average_precision": precision})

    again: dict[str, Any] = {"settings": settings, "memory": memory}
    tuned = finetuned or {}
    total, done, parts = len(heads) * len(rows.train) * len(features), 0, []
    for head in (*heads, *([FINETUNED] if tuned else [])):
        for count, own in rows.train.items():
            answers = {name: each[count] for name, each in tuned.items() if head == FINETUNED}
            for name, arrays in features.items() if head != FINETUNED else ():
                answers[name] = probes.probe_runs(head, arrays, task, own, rows.test, seeds, **again)
                done += 1
                if progress is not None:
                    progress(done, total)
            answers["majority"] = probes.majority_answers(task, own, len(truth))
            judged = bootstrap.with_verdicts([*map(scored, answers, answers.values())])
            parts.append(LinearPart(head, count, judged))
    dropped = int((~task.known).sum())
    return LinearComparison(tuple(parts), task.kind, task.names, len(rows.test), dropped, tuple(seeds))


def linear_tables(result: LinearComparison) -> list[ScoreTable]:
    """Every head at every number of labels, each with its differences to the strongest control."""
    tables, count = [], len(result.names)
    asked = f"{count} classes" if result.kind == "classes" else f"mean of {count} yes/no labels"
    asked = f"{result.n_test:,} rows tested, {asked}, {len(result.seeds)} seeds"
    if result.n_dropped:
        asked += f"; {result.n_dropped:,} rows without label left out"
    for part in result.parts:
        rows = f"{part.count:,} labelled rows"
        caption = f"{rows}, {PROBE_NAMES[part.head]}: {asked}"
        judged = f"{rows}, {part.head}: above the strongest control?"
        tables += judged_tables(caption, "features", part.rows, LINEAR_COLUMNS, judged)
    return tables


def finetune(
    model: Any, images: np.ndarray, task: Task, rows: np.ndarray, tested: np.ndarray, *,
    factors: Sequence[str] = ("geometry", "albedo"), seed: int = 0,
    settings: probes.HeadSettings = probes.PAPER_HEAD, progress: Progress | None = None,
) -> np.ndarray:  # fmt: skip
    """Train copies of the factors' encoders with a new head, answer for the test rows: (T, A) probabilities.

    The model, ours or a baseline, stays as it was. ``images`` are (N, 3, H, W) uint8, ``rows`` (n,) training
    rows. The seed is of the head's start and the order of images. ``progress`` is called with (epochs done,
    epochs in all). A ValueError: features without a gradient.
    """
    device, ours = model.device, isinstance(model, Derenderer)
    chosen = {name: model.nets[name] for name in factors} if ours else {"whole": model}
    nets: Any = nn.ModuleDict(copy.deepcopy(chosen)).requires_grad_(True).train()

    def embed(numbers: np.ndarray) -> torch.Tensor:
        pictures = as_float(np.ascontiguousarray(images[numbers])).to(device)
        if ours:
            return torch.cat([net.encoder(pictures) for net in nets.values()], dim=1)
        return torch.cat([*nets["whole"].embed(pictures).values()], dim=1)

    generator = torch.Generator().manual_seed(seed)
    targets = torch.from_numpy(task.targets).float().to(device)
    if not (first := embed(rows[:2])).requires_grad:
        raise ValueError(f"features of {type(model).__name__} have no gradient: leave it out of finetune")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        head = nn.Linear(first.shape[1], targets.shape[1]).to(device)
    optimiser = torch.optim.Adam([*nets.parameters(), *head.parameters()], lr=settings.learning_rate)
    for epoch in range(settings.epochs):
        order = torch.from_numpy(rows)[torch.randperm(len(rows), generator=generator)]
        for batch in order.split(settings.batch_size):
            logits, asked = head(embed(batch.numpy())), targets[batch.to(device)]
            loss = probes.head_loss(logits[None], asked[None], task.kind).sum()
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            optimiser.step()
        if progress is not None:
            progress(epoch + 1, settings.epochs)
    nets.eval()
    with torch.inference_mode():
        parts = np.array_split(tested, max(1, len(tested) // 256))
        answers = (probes.probabilities(head(embed(part)), task.kind) for part in parts)
        return np.concatenate([answer.cpu().numpy() for answer in answers])
