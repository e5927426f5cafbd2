"""Rows of a comparison: feature tables of the same pictures, checked against each other, and their labels.

A row is one kind of feature; several tables in one row are runs of the same thing (seeds), and their spread
is shown. Leaves out where tables come from and every score.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from derender.evaluation.clustering import at_least
from derender.features import FeatureTable, missing


@dataclass(frozen=True)
class FeatureRow:
    """One kind of feature.

    Attributes:
        name: shown in the table.
        tables: one for each run.
        factors: which of its features, side by side; None means all.
        control: whether it learned nothing.
    """

    name: str
    tables: tuple[FeatureTable, ...]
    factors: tuple[str, ...] | None = None
    control: bool = False


@dataclass(frozen=True)
class Prepared:
    """What protocols take: arrays of the same N rows.

    Attributes:
        features: by name, one (N, D) array for each run.
        labels: by name, (N,).
        files: (N,) names of the rows.
        controls: names of the rows that learned nothing.
        n_dropped: rows left out before because a label was missing.
        partition: the owners' split, or None.
        kept: further columns that were asked for, by name.
    """

    features: dict[str, list[np.ndarray]]
    labels: dict[str, np.ndarray]
    files: tuple[str, ...]
    controls: tuple[str, ...]
    n_dropped: int
    partition: np.ndarray | None
    kept: dict[str, np.ndarray]


def prepare(
    rows: Sequence[FeatureRow],
    labels: Sequence[str],
    *,
    mean_by: Sequence[str] = (),
    min_count: int = 1,
    max_count: int | None = None,
    keep: Sequence[str] = (),
) -> Prepared:
    """Check that all tables fit together; average, choose rows; labels are those of the first table.

    Args:
        rows: the first one's labels count.
        labels: columns to score by; an unknown name is an error that names the nearest.
        mean_by: average the features first over rows that share these labels, as for face tracks.
        min_count: leave out classes of fewer rows (with a single label only).
        max_count: keep at most that many rows of a class, the first ones (with a single label only).
        keep: further label columns to hand through.
    """
    check_rows(rows)
    first = rows[0].tables[0]
    columns = {name: first.label(name) for name in (*labels, *mean_by)}
    if (min_count > 1 or max_count is not None) and len(labels) != 1:
        raise ValueError(f"--min-count and --max-count go with one label, not with {len(labels)}")
    dropped, kept, chosen = 0, np.arange(len(first)), None
    if mean_by:
        absent = np.any([missing(column) for column in columns.values()], axis=0)
        dropped, kept = int(absent.sum()), np.flatnonzero(~absent)
        first = first.select(kept).mean_by(*mean_by)
        differing = [name for name in labels if name not in first.labels]
        if differing:
            raise ValueError(
                f"label {differing[0]!r} differs inside groups of {', '.join(mean_by)}: average by it too"
            )
    if min_count > 1 or max_count is not None:
        values = first.label(labels[0])
        chosen = np.union1d(at_least(values, min_count, max_count), np.flatnonzero(missing(values)))
        first = first.select(chosen)

    def array(row: FeatureRow, table: FeatureTable) -> np.ndarray:
        table = replace(table, labels=rows[0].tables[0].labels)
        if mean_by:
            table = table.select(kept).mean_by(*mean_by)
        return (table if chosen is None else table.select(chosen)).concatenate(row.factors)

    return Prepared(
        {row.name: [array(row, table) for table in row.tables] for row in rows},
        {name: first.label(name) for name in labels},
        first.files,
        tuple(row.name for row in rows if row.control),
        dropped,
        first.labels.get("partition"),
        {name: first.label(name) for name in keep},
    )


def check_rows(rows: Sequence[FeatureRow]) -> None:
    """All tables are of the same pictures, names are unique, runs of one row are of one kind of model."""
    if not rows:
        raise ValueError("a comparison needs at least one feature table")
    names = [row.name for row in rows]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise ValueError(f"two rows have the name {twice[0]!r}: give each its own")
    first = rows[0].tables[0]
    for row in rows:
        for table in row.tables:
            _check_same_pictures(rows[0].name, first, row.name, table)
            _check_same_model(row.name, row.tables[0], table)


def _check_same_pictures(name: str, first: FeatureTable, other_name: str, other: FeatureTable) -> None:
    if len(first) != len(other):
        raise ValueError(
            f"features {name!r} have {len(first)} rows and {other_name!r} {len(other)}: one table compares "
            "features of the same pictures; embed the same data for each"
        )
    differing = [(a, b) for a, b in zip(first.files, other.files, strict=True) if a != b]
    if differing:
        raise ValueError(
            f"features {name!r} and {other_name!r} are of different pictures, in {len(differing)} of "
            f"{len(first)} rows ({differing[0][0]} and {differing[0][1]}): embed the same data for each"
        )


def _check_same_model(name: str, first: FeatureTable, other: FeatureTable) -> None:
    sizes = [
        {factor: values.shape[1] for factor, values in table.factors.items()} for table in (first, other)
    ]
    made_by = [
        [table.origin.get(name) for name in ("model", "settings", "control")] for table in (first, other)
    ]
    if sizes[0] != sizes[1] or made_by[0] != made_by[1]:
        raise ValueError(
            f"row {name!r} mixes features of different models (another kind, factors, sizes or settings): "
            "several tables of one name are runs of the same model; give each model its own name"
        )
