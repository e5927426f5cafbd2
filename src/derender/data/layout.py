"""What a data set's layout is: a name, how to recognise it, and how to read its files and labels.

Labels are columns aligned with the files. Text columns are string arrays with "" where unknown; numbers are
float32 with NaN where unknown; yes/no attributes are int8 with 1 yes, 0 no, -1 unknown.
"""

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import PurePosixPath

import numpy as np
from jaxtyping import Float32

from derender.data.source import Skipped, Source

Labels = dict[str, np.ndarray]

PARTITION_NAMES = {
    "train": "train",
    "training": "train",
    "val": "validation",
    "valid": "validation",
    "validation": "validation",
    "dev": "validation",
    "test": "test",
    "testing": "test",
    "eval": "test",
}
"""What people call the parts of a split, and what they are called here."""


@dataclass(frozen=True)
class Table:
    """The pictures of a data set before any is decoded.

    Attributes:
        files: pictures, as named by the source.
        labels: columns by name, one value per file.
        partition: the owners' own split of each file ("train", "validation", "test"; "" unknown), or None.
        boxes: (N, 4) left, top, right, bottom of the part of each picture that is read, in pixels of the
            upright picture, or None for whole pictures. NaN: no box is known, and the picture is passed over.
        skipped: pictures that a user's own list names and that are not there, with reasons.
    """

    files: tuple[str, ...]
    labels: Labels = field(default_factory=dict)
    partition: np.ndarray | None = None
    boxes: Float32[np.ndarray, "n 4"] | None = None
    skipped: tuple[Skipped, ...] = ()

    def select(self, rows: np.ndarray) -> "Table":
        """The same table with only these rows."""
        return Table(
            tuple(self.files[row] for row in rows),
            {name: column[rows] for name, column in self.labels.items()},
            None if self.partition is None else self.partition[rows],
            None if self.boxes is None else self.boxes[rows],
            self.skipped,
        )


@dataclass(frozen=True)
class Layout:
    """One row of the registry (data/registry.py).

    Attributes:
        name: what the user writes to ask for this layout.
        title: what it is, in a few words.
        home: where the owners publish it; "" for layouts that are nobody's.
        recognise: whether a source looks like it, from the names of its files (and a header line).
        read: the table of one subset; None asks for the default. An error names the file that is missing.
        terms: on what terms the owners give it, in a few words; "" for layouts that are nobody's.
    """

    name: str
    title: str
    home: str
    recognise: Callable[[Source], bool]
    read: Callable[[Source, str | None], Table]
    terms: str = ""


def pictures_of(source: Source, subset: str | None = None) -> tuple[str, ...]:
    """Every picture of the source, or those in a folder ``subset`` at any depth."""
    if subset is None:
        return source.pictures
    inside = tuple(file for file in source.pictures if f"/{subset.strip('/')}/" in f"/{file}")
    if not inside:
        folders = sorted({PurePosixPath(file).parts[0] for file in source.pictures if "/" in file})
        known = f"its folders are {', '.join(folders[:8])}" if folders else "it has no folders with pictures"
        raise ValueError(f"{source.path} has no pictures in a folder {subset!r}; {known}")
    return inside


def part_of(table: Table, source: Source, subset: str | None, needed: str) -> Table:
    """The rows of one part of the official split, or all; ``needed`` is the file that gives the split."""
    if subset is None:
        return table
    if table.partition is None:
        raise ValueError(f"{source.path} has no official split, so no subset {subset!r}: {needed} is missing")
    rows = np.flatnonzero(table.partition == PARTITION_NAMES.get(subset.lower(), ""))
    if not len(rows) or subset.lower() not in PARTITION_NAMES:
        known = sorted(set(table.partition.tolist()) - {""})
        raise ValueError(f"{source.path} has no subset {subset!r}; there are {', '.join(known) or 'none'}")
    return table.select(rows)


def count_unknown(column: np.ndarray) -> int:
    """How many values of a column of labels are unknown: "", NaN, or -1 of a yes/no attribute."""
    if column.dtype.kind == "U":
        return int((column == "").sum())
    return int(np.isnan(column).sum()) if column.dtype.kind == "f" else int((column == -1).sum())


def text_column(values: Iterable[str]) -> np.ndarray:
    return np.array(list(values), dtype=np.str_)


def number_column(values: Iterable[float]) -> np.ndarray:
    return np.array(list(values), dtype=np.float32)


def read_csv(source: Source, file: str, required: Sequence[str]) -> list[Mapping[str, str]]:
    """The rows of a CSV file with a header; a missing column or a ragged row is an error that names it."""
    reader = csv.DictReader(io.StringIO(source.read_text(file), newline=""))
    try:
        header = [name.strip() for name in reader.fieldnames or ()]
        reader.fieldnames = header
        rows = [(reader.line_num, row) for row in reader]
    except csv.Error as problem:
        raise ValueError(f"{file} in {source.path} is no CSV table ({problem})") from problem
    missing = [name for name in required if name not in header]
    if missing:
        raise ValueError(
            f"{file} in {source.path} has no column {missing[0]!r}; its columns are {', '.join(header)}"
        )
    for number, row in rows:
        if None in row or None in row.values():
            raise ValueError(
                f"{file} in {source.path}, line {number}: expected {len(header)} values as in the header"
            )
    return [row for _, row in rows]


def header_of(source: Source, file: str) -> list[str]:
    """The column names in the first line of a CSV file, or none if it is not text."""
    try:
        return [name.strip() for name in source.read_text(file).split("\n", 1)[0].split(",")]
    except (ValueError, OSError):
        return []
