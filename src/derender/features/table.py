"""FeatureTable: one row per image, one feature per factor, labels, and where it all came from.

The value that travels through the right half of the program. Leaves out how features are made (extract.py,
baselines/) and every score (evaluation/).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from derender.data import missing, suggestion
from derender.storage.places import counted


def named(values: Mapping[str, Any], name: str, kind: str) -> Any:
    """``values[name]``; an unknown name is an error that names the nearest."""
    if name not in values:
        have = ", ".join(values) or "none"
        raise ValueError(f"unknown {kind} {name!r}{suggestion(name, values)}; there is {have}")
    return values[name]


def chosen(names: Sequence[str] | None, among: Mapping[str, Any], kind: str = "factor") -> list[str]:
    """Names, one or several, None for all; none, or one that is not there, is an error."""
    names = [names] if isinstance(names, str) else list(among if names is None else names)
    if not names:
        raise ValueError(f"name at least one {kind}; there is {', '.join(among)}")
    for name in names:
        named(among, name, kind)
    return names


@dataclass(frozen=True, eq=False)
class FeatureTable:
    """N images, one feature per factor each.

    Attributes:
        files: where each row's image came from.
        factors: by name, (N, D) float32, finite; D may differ between factors.
        labels: by name, (N,) of any kind; ``missing`` says which values stand for unknown.
        origin: what made the table (model, version, preset, data): anything JSON can hold.
    """

    files: tuple[str, ...]
    factors: Mapping[str, np.ndarray]
    labels: Mapping[str, np.ndarray] = field(default_factory=dict)
    origin: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        factors = {name: np.ascontiguousarray(values, np.float32) for name, values in self.factors.items()}
        labels = {name: np.asarray(values) for name, values in self.labels.items()}
        given = {"factors": factors, "labels": labels, "origin": dict(self.origin)}
        vars(self).update(given, files=tuple(map(str, self.files)))
        if not factors:
            raise ValueError("a feature table needs at least one factor")
        if twice := set(factors) & set(labels) or {"file"} & {*factors, *labels}:
            raise ValueError(f"column name {min(twice)!r} is used twice: rename the factor or the label")
        for name, values in {**labels, **factors}.items():
            kind, ndim = ("label", 1) if name in labels else ("factor", 2)
            if values.ndim != ndim or 0 in values.shape[1:]:
                each = "one value" if ndim == 1 else "at least one number"
                raise ValueError(f"{kind} {name!r} must have {each} in each row, got shape {values.shape}")
            if len(values) != len(self):
                raise ValueError(f"{kind} {name!r} has {len(values)} rows, but there are {len(self)} files")
        check_finite(factors, self.files)

    def __len__(self) -> int:
        return len(self.files)

    def __repr__(self) -> str:
        sizes = (f"{name} {values.shape[1]}" for name, values in self.factors.items())
        return f"{counted(len(self), 'rows')}: {', '.join(sizes)}; labels: {', '.join(self.labels) or 'none'}"

    def concatenate(self, factors: Sequence[str] | None = None) -> np.ndarray:
        """Features of several factors side by side, (N, sum of D) float32; all of them by default."""
        return np.concatenate([self.factors[name] for name in chosen(factors, self.factors)], axis=1)

    def label(self, name: str) -> np.ndarray:
        """One label column; an unknown name is an error that names the nearest."""
        return named(self.labels, name, "label")

    def select(self, rows: Any) -> "FeatureTable":
        """The rows given by a slice, a list of indices or a bool mask."""
        rows = rows if isinstance(rows, slice) or np.size(rows) else slice(0)
        chosen = np.arange(len(self))[rows if isinstance(rows, slice) else np.asarray(rows)].reshape(-1)
        return type(self)(
            tuple(self.files[row] for row in chosen),
            {name: values[chosen] for name, values in self.factors.items()},
            {name: values[chosen] for name, values in self.labels.items()},
            self.origin,
        )

    def mean_by(self, *labels: str) -> "FeatureTable":
        """One row for each distinct combination of labels (a face track, say): the mean feature of its rows.

        Rows with one of these labels missing are left out. Of the labels those are kept that are constant
        inside every group. ``files`` becomes the labels' values joined by "/".
        """
        if not labels:
            raise ValueError(f"name labels to average by; there is {', '.join(self.labels) or 'none'}")
        columns = [self.label(name) for name in labels]
        table = self.select(~np.any([missing(column) for column in columns], axis=0))
        keys = list(zip(*(table.labels[name].tolist() for name in labels), strict=True))
        number = {key: position for position, key in enumerate(dict.fromkeys(keys))}
        group = np.array([number[key] for key in keys], dtype=np.int64)
        first = np.unique(group, return_index=True)[1]
        total = {name: np.zeros((len(number), values.shape[1])) for name, values in table.factors.items()}
        for name, values in table.factors.items():
            np.add.at(total[name], group, values)

        def constant(column: np.ndarray) -> bool:
            return np.array_equal(column[first][group], column, equal_nan=column.dtype.kind == "f")

        return type(self)(
            tuple("/".join(map(str, key)) for key in number),
            {name: values / np.bincount(group)[:, None] for name, values in total.items()},
            {name: column[first] for name, column in table.labels.items() if constant(column)},
            {**self.origin, "mean_by": list(labels)},
        )

    def write(self, path: str | Path) -> Path:
        """Write parquet; at ``path`` stands the old file or the whole new one, never half of it."""
        from derender.features.parquet import write_tables

        write_tables(Path(path), [self])
        return Path(path)

    @classmethod
    def read(cls, path: str | Path, only: str | None = None) -> "FeatureTable":
        """Read what ``write`` wrote, or any parquet with a column ``file`` and columns of equal lists.

        With ``only``, a factor's name, no other factor is read: much faster where a table is large.
        """
        from derender.features.parquet import read_table

        return read_table(Path(path), only)


def check_finite(factors: Mapping[str, np.ndarray], files: Sequence[str]) -> None:
    """A feature that is no finite number is an error that names the first image concerned."""
    for name, values in factors.items():
        if not (finite := np.isfinite(values).all(axis=1)).all():
            rows = f"{int((~finite).sum())} of {len(values)} rows, first in {files[int(np.argmin(finite))]}"
            raise ValueError(f"factor {name!r} is not finite in {rows}: drop these, or check the model")
