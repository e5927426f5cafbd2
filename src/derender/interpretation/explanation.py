"""Which factor answers a question: shares over seeds and images, beside probes that learned nothing.

Every seed chooses training rows and fits a probe; shares and scores are of the test rows, which no seed
learns from. Controls: the same features with shuffled labels in the training rows, and an untrained encoder.
``drop`` is a second opinion without gradients: the AUC lost when one factor's features are exchanged.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from sklearn.metrics import roc_auc_score

from derender.baselines.controls import untrained_twin
from derender.data import ImageSet, suggestion
from derender.evaluation.bootstrap import once_and_resampled
from derender.evaluation.clustering_methods import clusterings
from derender.evaluation.feature_rows import chosen_labels
from derender.evaluation.image_scores import image_rows
from derender.evaluation.linear_task import Rows, Task, choose_rows
from derender.evaluation.score_table import Scores
from derender.features import FeatureTable, embed_image_set, embed_images
from derender.inputs import as_images, as_model
from derender.interpretation import tables
from derender.interpretation.attribution import Similarity, captum_attr, factor_shares, integrated_gradients
from derender.interpretation.probe import Probe, fit_probe, question
from derender.storage.places import require_known

BOOTSTRAP = 500
LEARNED_SHARE, LEARNED_MOST = 0.4, 500


@dataclass(frozen=True, eq=False)
class Explained:
    """An explanation of a model's features on labelled images.

    ``shares`` are of each factor in every answer. ``clusters`` and ``pair`` (two file names and parts) are
    there if requested. ``checks``, how maps answer to fresh weights, are filled when maps are drawn.
    ``left_out`` are notes on yes/no labels with too few images of one answer.
    """

    shares: tables.Explanation
    model: Any
    images: ImageSet
    task: Task
    split: Rows
    clusters: tables.ClusterShares | None = None
    pair: tuple[tuple[str, str], tables.PairParts] | None = None
    checks: Sequence[Similarity] = ()
    left_out: Sequence[str] = ()

    @property
    def scores(self) -> Scores:
        """Every table, the numbers as JSON takes them, and verdicts in words."""
        shown = [tables.share_table(self.shares), tables.drop_table(self.shares)]
        shown += [tables.sanity_table(self.checks)] if self.checks else []
        shown += [tables.cluster_share_table(self.clusters)] if self.clusters is not None else []
        shown += [tables.pair_table(self.pair[1], self.pair[0])] if self.pair is not None else []
        same = tables.unchanged(self.checks, "random weights")
        stuck = (f"not to be trusted, fresh weights give the same map: {name}" for name in same)
        values = {"source": self.images.source, "sanity": self.checks, "clusters": self.clusters}
        values |= {**self.shares.numbers(), "pair": None if self.pair is None else self.pair[1]}
        return Scores(shown, values, [*tables.share_verdicts(self.shares), *stuck, *self.left_out])

    def __repr__(self) -> str:
        return repr(self.scores)

    _repr_markdown_ = __repr__


def explain(
    images: ImageSet | str | Path, model: Any = "faces-64", labels: str | Sequence[str] = (), *,
    bins: int | None = None, min_count: int = 2, dataset: str = "auto", limit: int | None = None,
    part: str = "all", seeds: int = 3, count: int | None = None, groups: str | None = None,
    head: str = "logistic", output: str = "logit", baseline: str = "zero", clusters: int | None = None,
    pair: tuple[str, str] | None = None, batch_size: int = 256, seed: int = 0, device: str = "auto",
    progress: Callable[[str], Callable[[int, int], object]] = lambda _: lambda _done, _total: None,
) -> Explained:  # fmt: skip
    """Which factor of a model answers a question about images: shares of integrated gradients, with controls.

    Args:
        images: an image set with labels, or the address of one.
        model: a trained model or its name.
        labels: the label column of the question, several of two values each, or none: every yes/no label.
        bins, min_count: see `interpretation.question`.
        dataset, limit, part: how an address is read, see `derender.inputs.as_images`.
        seeds: number of probes to average over.
        count: images to learn from; by default 2 of 5, at most 500.
        groups: a label whose rows stay on one side of the split, such as identity.
        head, output, baseline: see ``explain_labels``.
        clusters: also find the parts of the distance between so many Ward clusters.
        pair: also find the parts of the distance between these two images, by file name.
        batch_size: images at a time; changes speed and memory only.
        seed: of the first probe, of clusters and pairs; others follow.
        device: "auto", "cpu" or "cuda".
        progress: called with the name of each stage; the result is called with (done, total).

    Raises:
        ValueError: no such label, too few images, or captum is not installed.
    """
    captum_attr()
    net = as_model(model, device=device)
    named = str(model) if isinstance(model, str | Path) else getattr(model, "source", None)
    reading = {"dataset": dataset, "limit": limit, "part": part, "model": named}
    images = as_images(images, net.image_size, **reading, progress=progress("reading"))
    for name in pair or ():
        if name not in images.files:
            raise ValueError(f"{images.source} has no image {name!r}{suggestion(name, images.files)}")
    table = embed_image_set(net, images, batch_size=batch_size, progress=progress("embedding"))
    names, left_out = (labels,) if isinstance(labels, str) else tuple(dict.fromkeys(labels)), []
    if not names:
        names, left_out = chosen_labels(table, None, True, least=max(min_count, 1))
    task = question(table.labels, names, bins=bins, min_count=min_count, source=images.source)
    own = range(seed, seed + seeds)
    split = split_rows(task, table, count, own, groups)
    untrained = []
    for one in own:
        how = {"batch_size": batch_size, "progress": progress(f"untrained encoder {one}")}
        untrained.append(embed_images(untrained_twin(net, one), images.images, **how))
    how = {"head": head, "output": output, "baseline": baseline, "progress": progress("probing")}
    shares = explain_labels(table.factors, task, split, untrained=untrained, seeds=own, **how)
    apart = alike = None
    if clusters is not None:
        made = clusterings(table.concatenate(), [clusters], seed=seed)[clusters]
        apart = tables.cluster_shares(table.factors, made, seed=seed)
    if pair is not None:
        alike = pair, tables.pair_parts(table.factors, *map(images.files.index, pair), seed=seed)
    return Explained(shares, net, images, task, split, apart, alike, left_out=left_out)


def split_rows(
    task: Task, table: FeatureTable, count: int | None, seeds: Sequence[int], groups: str | None = None
) -> Rows:
    """Half of the images is tested; each seed learns from its own choice of ``count`` others.

    The split of the data's owners holds, unless every labelled image here is in their test part.
    """
    wanted = count or max(2, min(LEARNED_MOST, int(LEARNED_SHARE * task.known.sum())))
    owners = table.labels.get("partition")
    if owners is not None and (owners[task.known] == "test").all():
        owners = None
    sides = table.label(groups) if groups else None
    return choose_rows(task, table.files, (wanted,), seeds, partition=owners, groups=sides)


def explain_labels(
    features: tables.Features, task: Task, split: Rows, *, untrained: Sequence[tables.Features] = (),
    seeds: Sequence[int] = (0, 1, 2), head: str = "logistic", output: str = "logit", baseline: str = "zero",
    progress: Callable[[int, int], object] | None = None,
) -> tables.Explanation:  # fmt: skip
    """Shares of each factor, (N, D_f) by name, in the answers to a task, with controls.

    ``split`` has one number of training rows and S choices, for the S ``seeds`` of probes and shuffled
    labels. ``untrained`` are features of untrained encoders for the first seeds. ``head`` is "logistic" or
    the paper's "linear", ``output`` "logit" or "probability"; ``baseline`` "zero" (the paper's) or the
    training rows' "mean". ``progress`` is called with (probes done, probes in all).
    """
    require_known("baseline", baseline, ("zero", "mean"))
    if len(split.train) != 1:
        raise ValueError(f"an explanation learns from one number of rows, got {len(split.train)}")
    ((count, train),) = split.train.items()
    if len(train) != len(seeds):
        raise ValueError(f"{len(seeds)} seeds need as many choices of rows, got {len(train)}")
    runs: dict[str, list[tuple[Any, ...]]] = {"model": [], "shuffled labels": [], "untrained encoder": []}
    total = 2 * len(seeds) + min(len(untrained), len(seeds))
    for place, (seed, rows) in enumerate(zip(seeds, train, strict=True)):
        mixed = task.targets.copy()
        mixed[rows] = mixed[np.random.default_rng(seed).permutation(rows)]
        tried = [("model", features, task), ("shuffled labels", features, replace(task, targets=mixed))]
        tried += [("untrained encoder", values, task) for values in untrained[place : place + 1]]
        for name, values, asked in tried:
            probe = fit_probe(values, asked, rows, head=head, seed=seed)
            start = None if baseline == "zero" else probe.columns(values)[rows].mean(axis=0)
            z, targets = probe.columns(values)[split.test], task.targets[split.test]
            parts = _shares(probe, z, targets, start, output)
            runs[name].append((probe, *parts, *scores(probe, z, targets, seed)))
            if progress is not None:
                progress(sum(map(len, runs.values())), total)
    first, shuffled = (runs[name][0][0] for name in ("model", "shuffled labels"))
    shares = tuple(_row(name, [result for _, *result in own]) for name, own in runs.items() if own)
    results = task.kind, task.names, first.factors, shares, first, shuffled
    return tables.Explanation(*results, count, len(split.test), head, output, baseline)


def _shares(
    probe: Probe, z: np.ndarray, targets: np.ndarray, start: np.ndarray | None, output: str
) -> tuple[np.ndarray, np.ndarray]:
    """Per image (T, A, F) shares, NaN where not asked; and (2,) the largest completeness error and change."""
    shares, largest = np.full((*targets.shape, len(probe.sizes)), np.nan), np.zeros(2)
    for answer in range(targets.shape[1]):
        asked = targets[:, answer] >= (0 if probe.kind == "labels" else 1)
        result, delta = integrated_gradients(probe, z[asked], answer, baseline=start, output=output)
        shares[asked, answer] = factor_shares(result, probe)
        both = np.abs([delta, result.sum(axis=1) - delta])
        largest = np.maximum(largest, both.max(axis=1, initial=0))
    return shares, largest


def scores(probe: Probe, z: np.ndarray, targets: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """AUC of each answer, (A,), and how much is lost when each factor is exchanged between images, (A, F)."""
    z, weight = z.astype(np.float64), probe.weight.astype(np.float64)
    parts = [z[:, columns] @ weight[:, columns].T for columns in probe.slices.values()]
    logits = np.sum(parts, axis=0) + probe.bias
    auc = _auc(targets, logits, probe.kind)
    order = np.random.default_rng(seed).permutation(len(z))
    drops = [auc - _auc(targets, logits - part + part[order], probe.kind) for part in parts]
    return auc, np.stack(drops, axis=1)


def _auc(targets: np.ndarray, logits: np.ndarray, kind: str) -> np.ndarray:
    """NaN where the test rows have one value only."""
    result = np.full(targets.shape[1], np.nan)
    if kind == "classes":  # a class's lead over the best of the others: what decides the answer
        second, best = np.sort(logits, axis=1)[:, -2:, None].transpose(1, 0, 2)
        logits = logits - np.where(logits == best, second, best)
    for answer, (truth, value) in enumerate(zip(targets.T, logits.T, strict=True)):
        rows = truth >= 0
        if len(np.unique(truth[rows])) == 2:
            result[answer] = roc_auc_score(truth[rows], value[rows])
    return result


def _row(name: str, runs: Sequence[Sequence[np.ndarray]]) -> tables.ShareRow:
    shares, largest, auc, drop = map(np.stack, zip(*runs, strict=True))  # shares: (S, T, A, F)
    known = np.ma.masked_invalid(shares)
    each = known.mean(axis=0).filled(np.nan)  # of images
    cells = {str(at): values for at, values in enumerate(each.reshape(len(each), -1).T)}
    (scored,) = image_rows({name: cells}, {}, once_and_resampled(len(each), BOOTSTRAP))
    ends = np.array([(one.low, one.high) for one in scored.scores.values()])
    low, high = ends.T.reshape(2, *each.shape[1:])
    error, scale = largest.max(axis=0)
    error = float(error / scale) if scale > 0 else 0.0
    means = known.mean(axis=1).filled(np.nan)
    return tables.ShareRow(name, name != "model", means, low, high, auc, drop, error)
