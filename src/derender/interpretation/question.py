"""Label columns as what a probe is asked: classes as they are, numbers cut into bins of equal size.

Leaves out the choice of rows (``derender.evaluation.linear_task``).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from derender.data import suggestion
from derender.evaluation.linear_task import Task, task_of
from derender.features import missing

FEWEST_PICTURES = 20
BINS = 3


def question(
    labels: Mapping[str, np.ndarray],
    names: Sequence[str],
    *,
    bins: int | None = None,
    min_count: int = 2,
    source: str = "the data",
) -> Task:
    """What to ask: one column of any kind, or several of two values each.

    Args:
        labels: by name, (N,) each.
        names: the columns to ask.
        bins: cut numbers at quantiles into so many classes; None: 3 for columns of fractions, while whole
            numbers are classes as they are (an identity's number is no quantity).
        min_count: values that fewer pictures have count as unknown.
        source: of the labels, for messages.

    Raises:
        ValueError: no labels, an unknown name, one class, fewer than 20 labelled pictures.
    """
    if not labels:
        raise ValueError(
            f"{source} has no labels, and an explanation needs an answer to explain: add a table"
        )
    for name in names:
        if name not in labels:
            raise ValueError(
                f"{source} has no label {name!r}{suggestion(name, labels)}; there is {', '.join(labels)}"
            )
    columns = {name: without_rare(in_bins(np.asarray(labels[name]), bins), min_count) for name in names}
    for name, values in columns.items():
        known = values[~missing(values)]
        if len(known) < FEWEST_PICTURES:
            raise ValueError(
                f"label {name!r} of {source} is known for {len(known)} pictures, and an explanation needs "
                f"{FEWEST_PICTURES} or more: add pictures or choose another label"
            )
        if len(set(known.tolist())) < 2:
            others = [other for other in labels if other != name and _classes(labels[other]) > 1]
            close = suggestion(name, others)
            raise ValueError(
                f"every labelled picture of {source} has {name} {known[0]}, so there is nothing to tell "
                f"apart{close}; labels with two classes or more: {', '.join(others) or 'none'}"
            )
    task = task_of(columns)
    if task.kind == "classes":
        return task
    return replace(task, names=tuple(_said(name, values) for name, values in columns.items()))


def in_bins(values: np.ndarray, bins: int | None = None) -> np.ndarray:
    """Numbers as the names of their bins, ``"1: 0.5 to 2"``; unknown ones as "". Other columns unchanged."""
    kind = values.dtype.kind
    if kind not in "iuf" or values.dtype == np.int8 or (kind != "f" and bins is None):
        return values
    known = ~missing(values)
    count = BINS if bins is None else bins
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
    kept = values.astype(object)
    kept[rare | ~known] = None
    return kept


def _said(name: str, values: np.ndarray) -> str:
    """A column of two values by what a yes means: its name, or name and value where the values are words."""
    if np.asarray(values).dtype.kind in "bi":
        return name
    return f"{name}: {max(set(values[~missing(values)].tolist()))}"


def _classes(values: np.ndarray) -> int:
    values = np.asarray(values)
    return len(set(values[~missing(values)].tolist()))
