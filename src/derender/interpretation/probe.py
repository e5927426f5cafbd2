"""A linear probe on the features of several factors: its question, fitted, written, read.

A question is label columns: classes as they are, numbers cut into bins of equal size. Two ways to fit are
those of ``evaluation/linear_probes.py``: ``logistic``, the penalised regression, and ``linear``, the paper's
head. Weights of classes are centred over the classes: the logit of a class is its lead over the mean.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from safetensors.numpy import save
from scipy.special import expit, softmax

from derender.data import suggestion
from derender.evaluation.linear_probes import PAPER_HEAD, HeadSettings, fitted_heads, logistic_weights
from derender.evaluation.linear_task import Task, task_of
from derender.features import missing, named
from derender.settings import Settings
from derender.storage.atomic import new_folder
from derender.storage.bounded import read_json
from derender.storage.places import require_known
from derender.storage.tensors import read_tensors

HEADS = ("logistic", "linear")
PENALTIES = (1e-1, 1.0, 1e1)
FOLDS = 3
FEWEST_IMAGES = 20
BINS = 3
FORMAT = 1
WEIGHTS_FILE, CONFIG_FILE = "probe.safetensors", "probe.json"


def question(
    labels: Mapping[str, np.ndarray], names: Sequence[str], *, bins: int | None = None, min_count: int = 2,
    source: str = "the data",
) -> Task:  # fmt: skip
    """Label columns as a task: one column of any kind, or several of two values each.

    Args:
        labels: by name, (N,) each.
        names: the columns.
        bins: cut numbers at quantiles into so many classes; None: 3 for columns of fractions, while whole
            numbers are classes as they are (an identity's number is no quantity).
        min_count: values that fewer images have count as unknown.
        source: of the labels, for messages.

    Raises:
        ValueError: no labels, an unknown name, one class, fewer than 20 labelled images.
    """
    if not labels:
        raise ValueError(f"{source} has no labels, and an explanation needs answers to explain: add a table")
    columns, known = {}, {}
    for name in names:
        values = named(labels, name, f"label of {source}")
        columns[name] = without_rare(in_bins(values, bins), min_count)
        known[name] = columns[name][~missing(columns[name])].tolist()
        if len(known[name]) < FEWEST_IMAGES:
            few = f"is known for {len(known[name])} images, and an explanation needs {FEWEST_IMAGES} or more"
            raise ValueError(f"label {name!r} of {source} {few}: add images or choose another label")
        if len(set(known[name])) < 2:
            rest = {other: own[~missing(own)].tolist() for other, own in labels.items() if other != name}
            others = [other for other, answers in rest.items() if len(set(answers)) > 1]
            why = f"has {name} {known[name][0]}, so there is nothing to distinguish{suggestion(name, others)}"
            able = f"labels with two classes or more: {', '.join(others) or 'none'}"
            raise ValueError(f"every labelled image of {source} {why}; {able}")
    task = task_of(columns)
    if task.kind == "classes":
        return task
    words = (name for name, values in columns.items() if values.dtype.kind not in "bi")
    yes = {name: f"{name}: {max(set(known[name]))}" for name in words}  # what a yes means
    return replace(task, names=tuple(yes.get(name, name) for name in columns))


def in_bins(values: np.ndarray, bins: int | None = None) -> np.ndarray:
    """Numbers as the names of their bins, ``"1: 0.5 to 2"``; unknown ones as "". Other columns unchanged."""
    kind = values.dtype.kind
    if kind not in "iuf" or values.dtype == np.int8 or (kind != "f" and bins is None):
        return values
    known, count = ~missing(values), BINS if bins is None else bins
    if count < 2:
        raise ValueError(f"numbers are cut into 2 bins or more, got {count}")
    if len(np.unique(values[known])) <= count:
        return values
    edges = np.unique(np.quantile(values[known], np.linspace(0, 1, count + 1)))
    bin_of = np.clip(np.searchsorted(edges[1:-1], values, side="right"), 0, len(edges) - 2)
    names = np.array([f"{i + 1}: {low:.4g} to {edges[i + 1]:.4g}" for i, low in enumerate(edges[:-1])])
    return np.where(known, names[bin_of], "")


def without_rare(values: np.ndarray, min_count: int) -> np.ndarray:
    """Values that fewer than ``min_count`` rows have as None; the column itself where there is none."""
    known = ~missing(values)
    distinct, counts = np.unique(values[known].astype(str), return_counts=True)
    rare = known & np.isin(values.astype(str), distinct[counts < min_count])
    if not rare.any():
        return values
    return np.where(known & ~rare, values.astype(object), np.array(None))


@dataclass(frozen=True, eq=False)
class Probe:
    """Logits that are linear in the features: (A, D) float32 weights and (A,) biases of A labels (yes or no)
    or classes.

    ``sizes`` holds the length of each factor's feature, in the order in which they stand side by side.
    """

    kind: str
    names: tuple[str, ...]
    sizes: Mapping[str, int]
    weight: np.ndarray
    bias: np.ndarray
    head: str = "logistic"

    def __post_init__(self) -> None:
        expected = (len(self.names), sum(self.sizes.values()))
        if self.weight.shape != expected or self.bias.shape != expected[:1]:
            needed = f"a probe of {expected[0]} answers and {expected[1]} features has weights {expected}"
            raise ValueError(f"{needed}, got {self.weight.shape} and bias {self.bias.shape}")

    @property
    def factors(self) -> tuple[str, ...]:
        return tuple(self.sizes)

    @property
    def slices(self) -> dict[str, slice]:
        """Where each factor's columns lie."""
        ends = np.cumsum(list(self.sizes.values())).tolist()
        return {name: slice(end - self.sizes[name], end) for name, end in zip(self.sizes, ends, strict=True)}

    def columns(self, features: Mapping[str, np.ndarray]) -> np.ndarray:
        """The features of its factors side by side, (N, D)."""
        for name, size in self.sizes.items():
            result = features[name].shape[1] if name in features else 0
            if result != size:
                needs = f"the probe needs {size} numbers of factor {name!r}, the features have {result}"
                raise ValueError(f"{needs}: use the model that it was fitted on")
        return np.concatenate([features[name] for name in self.sizes], axis=1)

    def logits(self, features: Mapping[str, np.ndarray]) -> np.ndarray:
        """(N, A) float64."""
        return self.columns(features).astype(np.float64) @ self.weight.T.astype(np.float64) + self.bias

    def probabilities(self, features: Mapping[str, np.ndarray]) -> np.ndarray:
        """(N, A) in 0..1."""
        logits = self.logits(features)
        return softmax(logits, axis=1) if self.kind == "classes" else expit(logits)

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path:
        """Write weights and what they mean to ``folder``; complete or not at all."""
        facts = {"format": FORMAT, "kind": self.kind, "names": self.names, "head": self.head}
        facts |= {"sizes": list(self.sizes.items())}
        with new_folder(folder, overwrite=overwrite, marker=CONFIG_FILE) as temporary:
            (temporary / WEIGHTS_FILE).write_bytes(save({"weight": self.weight, "bias": self.bias}))
            (temporary / CONFIG_FILE).write_text(json.dumps(facts, indent=1))
        return Path(folder)


class _ProbeFile(Settings):
    format: int
    kind: str
    names: tuple[str, ...]
    sizes: tuple[tuple[str, int], ...]
    head: str


def load_probe(folder: str | Path) -> Probe:
    """What ``Probe.save`` wrote.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is damaged, or of a newer version.
    """
    folder = Path(folder)
    if not (folder / CONFIG_FILE).is_file() or not (folder / WEIGHTS_FILE).is_file():
        raise FileNotFoundError(f"no probe at {folder}: give a folder with {CONFIG_FILE} and {WEIGHTS_FILE}")
    try:
        facts = read_json(folder / CONFIG_FILE, _ProbeFile)
        if facts.format > FORMAT:
            raise ValueError(f"format {facts.format} is newer than this version of derender")
        arrays = {name: value.numpy() for name, value in read_tensors(folder / WEIGHTS_FILE).items()}
        return Probe(facts.kind, facts.names, dict(facts.sizes), arrays["weight"], arrays["bias"], facts.head)
    except (KeyError, ValueError) as error:
        raise ValueError(f"the probe in {folder} cannot be read ({error}): fit it again") from error


def fit_probe(
    features: Mapping[str, np.ndarray], task: Task, rows: np.ndarray, *, head: str = "logistic",
    seed: int = 0, settings: HeadSettings = PAPER_HEAD,
) -> Probe:  # fmt: skip
    """Learn from (n,) rows of finite features by factor, each (N, D_f).

    ``head`` is "logistic" or "linear"; the seed is of folds, or of the start and the order of rows;
    ``settings`` are of the paper's head.
    """
    require_known("head", head, HEADS)
    sizes = {name: values.shape[1] for name, values in features.items()}
    x, y = np.concatenate(list(features.values()), axis=1)[rows], task.targets[rows]
    if head == "logistic":
        how = {"kind": task.kind, "penalties": PENALTIES, "folds": min(FOLDS, len(x)), "seed": seed}
        weight, bias, _ = logistic_weights(x, y, **how)
    else:
        every = np.arange(len(x))[None]
        _, result, start = fitted_heads(x, task.select(rows), every, [seed], settings, centred=False)
        weight, bias = result[0].double().numpy(), start[0, 0].double().numpy()
    if task.kind == "classes":
        weight, bias = weight - weight.mean(axis=1, keepdims=True), bias - bias.mean()
    return Probe(task.kind, task.names, sizes, weight.T.astype(np.float32), bias.astype(np.float32), head)
