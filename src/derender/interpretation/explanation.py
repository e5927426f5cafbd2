"""Which factor answers a question: shares over seeds and pictures, beside probes that know nothing.

Every seed draws training rows and fits a probe; shares and scores are of the test rows, which no seed learns
from. Controls under the same protocol: the same features with labels dealt at random among the training
rows, and an untrained encoder. ``drop`` is a second opinion without gradients: how much of the AUC is lost
when one factor's features are exchanged between test pictures. Leaves out maps over the picture (cam.py).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from sklearn.metrics import roc_auc_score

from derender.evaluation.bootstrap import LEVEL, resamples
from derender.evaluation.linear_head import PAPER_HEAD, HeadSettings
from derender.evaluation.linear_task import Rows, Task
from derender.interpretation.probe import Probe, fit_probe
from derender.interpretation.shares import factor_shares, integrated_gradients

Features = Mapping[str, np.ndarray]
BASELINES = ("zero", "mean")
BOOTSTRAP = 500


@dataclass(frozen=True, eq=False)
class ShareRow:
    """Shares of one set of features; S seeds, A labels or classes, F factors.

    Attributes:
        name: of the features.
        control: whether it learned nothing.
        shares: (S, A, F) mean share of |IG| over test pictures, 0..1, each sums to 1 over factors.
        low, high: (A, F) 95 % interval of the mean over seeds, over resamples of the test pictures.
        auc: (S, A) area under the ROC curve on the test rows; 0.5 for answers that know nothing, best 1.
        drop: (S, A, F) how much of it is lost when this factor's features are dealt at random.
        error: the largest completeness error, relative to the largest change of an answer.
    """

    name: str
    control: bool
    shares: np.ndarray
    low: np.ndarray
    high: np.ndarray
    auc: np.ndarray
    drop: np.ndarray
    error: float

    def numbers(self, names: Sequence[str], factors: Sequence[str]) -> dict[str, Any]:
        """As JSON takes it, by label and factor."""

        def one(answer: int) -> dict[str, Any]:
            parts = {
                factor: {
                    "share": self.shares[:, answer, place].mean(),
                    "low": self.low[answer, place],
                    "high": self.high[answer, place],
                    "spread": float(self.shares[:, answer, place].std(ddof=1))
                    if len(self.shares) > 1
                    else None,
                    "drop": self.drop[:, answer, place].mean(),
                }
                for place, factor in enumerate(factors)
            }
            return {"auc": self.auc[:, answer].mean(), "factors": parts}

        by_name = {name: one(answer) for answer, name in enumerate(names)}
        return {"control": self.control, "completeness_error": self.error, "answers": by_name}


@dataclass(frozen=True, eq=False)
class Explanation:
    """What was found.

    Attributes:
        kind: "labels" or "classes".
        names: (A) labels or classes.
        factors: (F) in the features' order.
        rows: the features in question first, then the controls.
        probe, shuffled: of the first seed, on the true labels and on labels dealt at random.
        n_train, n_test: rows.
        head, output, baseline: how probes were fitted and attributed.
    """

    kind: str
    names: tuple[str, ...]
    factors: tuple[str, ...]
    rows: tuple[ShareRow, ...]
    probe: Probe
    shuffled: Probe
    n_train: int
    n_test: int
    head: str
    output: str
    baseline: str

    def numbers(self) -> dict[str, Any]:
        """Everything as JSON takes it."""
        facts = {name: getattr(self, name) for name in ("kind", "names", "factors", "n_train", "n_test")}
        facts |= {name: getattr(self, name) for name in ("head", "output", "baseline")}
        return {**facts, "rows": {row.name: row.numbers(self.names, self.factors) for row in self.rows}}


def explain_labels(
    features: Features,
    task: Task,
    split: Rows,
    *,
    untrained: Sequence[Features] = (),
    seeds: Sequence[int] = (0, 1, 2),
    head: str = "logistic",
    settings: HeadSettings = PAPER_HEAD,
    output: str = "logit",
    baseline: str = "zero",
    steps: int | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> Explanation:
    """Shares of each factor in the answers to a task, with controls.

    Args:
        features: by factor, (N, D_f).
        task: what is asked of the N rows.
        split: who learns (one number of rows, S draws) and who is tested.
        untrained: features of untrained encoders, one for each of the first seeds; may be empty.
        seeds: (S) of probes and shufflings, one for each draw.
        head: "logistic" or the paper's "linear".
        settings: of the paper's head.
        output: what is attributed, "logit" or "probability".
        baseline: where the path starts, "zero" (the paper's) or the training rows' "mean".
        steps: of the quadrature; None for as many as the output needs.
        progress: called with (probes done, probes in all).
    """
    if baseline not in BASELINES:
        raise ValueError(f"unknown baseline {baseline!r}; there is {', '.join(BASELINES)}")
    if len(split.train) != 1:
        raise ValueError(f"an explanation learns from one number of rows, got {len(split.train)}")
    ((count, train),) = split.train.items()
    if len(train) != len(seeds):
        raise ValueError(f"{len(seeds)} seeds need as many draws of rows, got {len(train)}")
    kept: dict[str, list[_Measured]] = {"model": [], "shuffled labels": [], "untrained encoder": []}
    total, done = 2 * len(seeds) + min(len(untrained), len(seeds)), 0
    for place, (seed, rows) in enumerate(zip(seeds, train, strict=True)):
        tried = [("model", features, task), ("shuffled labels", features, shuffled(task, rows, seed))]
        if place < len(untrained):
            tried.append(("untrained encoder", untrained[place], task))
        for name, values, asked in tried:
            probe = fit_probe(values, asked, rows, head=head, seed=seed, settings=settings)
            start = None if baseline == "zero" else probe.columns(values)[rows].mean(axis=0)
            kept[name].append(_measure(probe, values, task, split.test, start, output, steps, seed))
            done += 1
            if progress is not None:
                progress(done, total)
    rows_of = [_row(name, name != "model", runs) for name, runs in kept.items() if runs]
    first = kept["model"][0].probe
    return Explanation(
        task.kind, task.names, first.factors, tuple(rows_of), first, kept["shuffled labels"][0].probe,
        count, len(split.test), head, output, baseline,
    )  # fmt: skip


def shuffled(task: Task, rows: np.ndarray, seed: int) -> Task:
    """The same task with the targets of ``rows`` dealt at random among them."""
    targets = task.targets.copy()
    targets[rows] = targets[np.random.default_rng(seed).permutation(rows)]
    return replace(task, targets=targets)


@dataclass(frozen=True, eq=False)
class _Measured:
    """One probe: per picture (T, A, F) shares (NaN where not asked), AUC and its drop, error and scale."""

    probe: Probe
    shares: np.ndarray
    auc: np.ndarray
    drop: np.ndarray
    error: float
    scale: float


def _measure(
    probe: Probe, features: Features, task: Task, test: np.ndarray,
    start: np.ndarray | None, output: str, steps: int | None, seed: int,
) -> _Measured:  # fmt: skip
    z, targets = probe.columns(features)[test], task.targets[test]
    shares = np.full((len(test), len(task.names), len(probe.sizes)), np.nan)
    error = scale = 0.0
    for answer in range(len(task.names)):
        asked = targets[:, answer] >= 0 if task.kind == "labels" else targets[:, answer] == 1
        found, delta = integrated_gradients(
            probe, z[asked], answer, baseline=start, output=output, steps=steps
        )
        shares[asked, answer] = factor_shares(found, probe)
        error = max(error, float(np.abs(delta).max(initial=0)))
        scale = max(scale, float(np.abs(found.sum(axis=1) - delta).max(initial=0)))
    auc, drop = scores(probe, z, targets, seed)
    return _Measured(probe, shares, auc, drop, error, scale)


def scores(probe: Probe, z: np.ndarray, targets: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """AUC of each answer, (A,), and how much each factor's exchange between pictures takes, (A, F)."""
    z, weight = z.astype(np.float64), probe.weight.astype(np.float64)
    parts = [z[:, columns] @ weight[:, columns].T for columns in probe.slices.values()]
    logits = np.sum(parts, axis=0) + probe.bias
    auc = _auc(targets, logits, probe.kind)
    order = np.random.default_rng(seed).permutation(len(z))
    drops = [auc - _auc(targets, logits - part + part[order], probe.kind) for part in parts]
    return auc, np.stack(drops, axis=1)


def _auc(targets: np.ndarray, logits: np.ndarray, kind: str) -> np.ndarray:
    """NaN where the test rows have one value only."""
    found = np.full(targets.shape[1], np.nan)
    if kind == "classes":  # a class's lead over the best of the others: what decides the answer
        top = np.sort(logits, axis=1)
        best, second = top[:, -1:], top[:, -2:-1]
        logits = logits - np.where(logits == best, second, best)
    for answer, (truth, value) in enumerate(zip(targets.T, logits.T, strict=True)):
        rows = truth >= 0
        if len(np.unique(truth[rows])) == 2:
            found[answer] = roc_auc_score(truth[rows], value[rows])
    return found


def _row(name: str, control: bool, runs: Sequence[_Measured]) -> ShareRow:
    pictures = np.stack([run.shares for run in runs])  # (S, T, A, F)
    per_seed = np.stack([_mean(run.shares) for run in runs])
    low, high = _interval(_mean(pictures))
    scale = max(run.scale for run in runs)
    return ShareRow(
        name,
        control,
        per_seed,
        low,
        high,
        np.stack([run.auc for run in runs]),
        np.stack([run.drop for run in runs]),
        max(run.error for run in runs) / scale if scale > 0 else 0.0,
    )


def _mean(shares: np.ndarray) -> np.ndarray:
    """Mean over the first axis of what is no NaN; NaN where nothing is."""
    known = np.isfinite(shares)
    count = known.sum(axis=0)
    total = np.where(known, shares, 0).sum(axis=0)
    return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)


def _interval(shares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(T, A, F) as the ends of the 95 % interval of the mean over pictures, (A, F) each."""
    known = np.isfinite(shares).reshape(len(shares), -1).astype(np.float32)
    values = np.where(np.isfinite(shares), shares, 0).reshape(len(shares), -1).astype(np.float32)
    means = []
    for weights in resamples(len(shares), BOOTSTRAP):
        count = weights @ known
        means.append(np.divide(weights @ values, count, out=np.full(count.shape, np.nan), where=count > 0))
    drawn = np.concatenate(means)
    ends = np.full((2, drawn.shape[1]), np.nan)
    some = np.isfinite(drawn).any(axis=0)
    ends[:, some] = np.nanquantile(drawn[:, some], [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=0)
    return ends[0].reshape(shares.shape[1:]), ends[1].reshape(shares.shape[1:])
