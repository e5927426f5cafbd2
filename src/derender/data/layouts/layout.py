"""What a data set's layout is, and what all of them read alike: folders, lists, tables, official parts.

Labels are columns aligned with the files. Text columns are string arrays with "" where unknown, numbers
float32 with NaN where unknown. Yes/no attributes are int8 with 1 yes, 0 no, -1 unknown.
"""

import csv
import hashlib
import io
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float32

from derender.data.source import Skipped, Source, evenly_spaced, stem_of
from derender.storage.bounded import table_beside
from derender.storage.places import require_known

Labels = dict[str, np.ndarray]

PARTITION_NAMES = {  # what people call the parts of a split, and what they are called here
    **dict.fromkeys(("train", "training"), "train"),
    **dict.fromkeys(("val", "valid", "validation", "dev"), "validation"),
    **dict.fromkeys(("test", "testing", "eval"), "test"),
}

TOLD = table_beside(__file__, "layouts.yaml")  # what is told of each layout, by its name

_MOSTLY = 0.9  # of the images must look right for a layout to be recognised: real sets hold a few odd names


@dataclass(frozen=True)
class Table:
    """The images of a data set before any is decoded."""

    files: tuple[str, ...]  # images, as named by the source
    labels: Labels = field(default_factory=dict)  # columns by name, one value per file
    partition: np.ndarray | None = None  # the owners' split: "train", "validation", "test"; "" unknown
    # of the parts that are read, left, top, right, bottom in pixels, upright; NaN: unknown, and passed over
    boxes: Float32[np.ndarray, "n 4"] | None = None  # None: whole images
    skipped: tuple[Skipped, ...] = ()  # images that a user's own list names and that are not there

    def select(self, rows: np.ndarray) -> "Table":
        """The same table with only these rows."""
        return Table(
            tuple(self.files[row] for row in rows),
            {name: column[rows] for name, column in self.labels.items()},
            None if self.partition is None else self.partition[rows],
            None if self.boxes is None else self.boxes[rows],
            self.skipped,
        )

    def at_most(self, limit: int | None) -> "Table":
        """The same table with at most so many rows, evenly spaced."""
        return self if limit is None else self.select(evenly_spaced(len(self.files), limit))


@dataclass(frozen=True)
class Layout:
    """One row of ``LAYOUTS``."""

    name: str  # what the user writes to ask for this layout
    recognise: Callable[[Source], bool]  # whether a source looks like it, by names of files (and a header)
    load: Callable[[Source], Table | None]  # every image with its labels; None where nothing is laid out so
    title: str  # what it is, in a few words
    expected: str = ""  # which files there must be, for messages
    home: str = ""  # where the owners publish it; "" for layouts without owners
    terms: str = ""  # on what terms the owners give it, in a few words; "" for layouts without owners
    split_from: str = ""  # the file that gives the official split, for messages
    default_parts: Sequence[str] = ()  # unless a part is asked for, the first that is there; () for all
    fit: str = "crop"  # what becomes of images that are not square (data/image.py)

    def read(self, source: Source, subset: str | None = None) -> Table:
        """The images of one part: of the official split, else those in a folder of that name at any depth."""
        if (table := self.load(source)) is None:
            what = f"{source.path} cannot be read as {self.name} ({self.title})"
            owners = f"; its owners publish it at {self.home}" if self.home else ""
            raise ValueError(f"{what}: expected {self.expected}{owners}")
        known = set() if table.partition is None else {*table.partition.tolist()}
        parts = sorted(known - {""})
        if subset is None and self.default_parts and len(known) > 1:
            subset = next((part for part in self.default_parts if part in known), None)
            if subset is None:
                raise ValueError(f"{source.path}: name one of its parts; there are {', '.join(parts)}")
        if subset is None:
            return table
        part = subset if subset in parts else PARTITION_NAMES.get(subset.lower())
        if part in parts:
            return table.select(np.flatnonzero(table.partition == part))
        inside = [row for row, file in enumerate(table.files) if f"/{subset.strip('/')}/" in f"/{file}"]
        if not inside:
            lacking = f"none ({self.split_from} is missing)" if self.split_from else "none"
            folders = sorted({file.partition("/")[0] for file in table.files if "/" in file})
            there = f"{', '.join(parts) or lacking}, its folders {', '.join(folders[:8]) or 'none'}"
            raise ValueError(f"{source.path} has no part {subset!r}: its parts are {there}")
        return table.select(np.array(inside))


T = TypeVar("T", bound=Any)


def half_of(rows: T, half: str) -> T:
    """The development or test half of a table, set of images or feature table, or "all" of it.

    A hash of its identity or model, else of its file's name without folders and suffix, puts a row into its
    half. So a person or a shape is in one half only, the same in every set, size and machine. The halves are
    about equally large. Choose settings on development, report test.

    Raises:
        ValueError: another half, or one that is empty.
    """
    require_known("half", half, ("all", "development", "test"))
    if half == "all":
        return rows
    keys = list(map(stem_of, rows.files))
    owner = next((name for name in ("identity", "model") if name in rows.labels), None)
    if owner is not None:
        owners = zip(rows.labels[owner].tolist(), keys, strict=True)
        keys = [key if value in ("", None) else str(value) for value, key in owners]
    chosen = np.flatnonzero([in_test_half(key) == (half == "test") for key in keys])
    if len(chosen) == 0:
        raise ValueError(f"the {half} half of {len(keys):,} rows is empty: use all of them")
    return rows.select(chosen)


def in_test_half(name: str) -> bool:
    """Whether a person, shape or image of this name belongs to the test half."""
    return hashlib.sha256(name.encode("utf-8", "surrogateescape")).digest()[0] % 2 == 1


def mostly(fits: Callable[[str], object], names: Iterable[str]) -> bool:
    """Whether nearly all of the names, and at least one, fit."""
    results = [bool(fits(name)) for name in names]
    return bool(results) and sum(results) >= _MOSTLY * len(results)


def partition_named(names: Iterable[str]) -> str:
    """The partition that the first name of one stands for, or ""."""
    return next((PARTITION_NAMES[name.lower()] for name in names if name.lower() in PARTITION_NAMES), "")


def partitions(files: Iterable[str]) -> np.ndarray | None:
    """The partition of each file by its outermost folder of such a name, or None where all are unknown."""
    return partition_column(partition_named(file.split("/")[:-1]) for file in files)


def partition_column(values: Iterable[str]) -> np.ndarray | None:
    """A column of partitions, or None where all are unknown."""
    column = text_column(values)
    return column if (column != "").any() else None


def missing(labels: np.ndarray) -> np.ndarray:
    """Which labels are missing, (N,) bool: None, NaN, an empty text, and -1 in int8 (yes/no attributes)."""
    labels = np.asarray(labels)
    if labels.dtype == np.int8:
        return labels == -1
    if labels.dtype.kind in "fbiu":
        return np.isnan(labels)
    return np.array([value is None or value != value or value == "" for value in labels.tolist()], dtype=bool)


def text_column(values: Iterable[str]) -> np.ndarray:
    return np.array(list(values), dtype=np.str_)


def read_csv(source: Source, file: str, required: Sequence[str] = ()) -> list[Mapping[str, str]]:
    """The rows of a CSV file with a header; a missing column or a ragged row is an error that names it."""
    where = f"{file} in {source.path}"
    reader = csv.DictReader(io.StringIO(source.read_text(file), newline=""))
    try:
        reader.fieldnames = header = [name.strip() for name in reader.fieldnames or ()]
        rows = [(reader.line_num, row) for row in reader]
    except csv.Error as problem:
        raise ValueError(f"{where} is no CSV table ({problem})") from problem
    for name in required:
        if name not in header:
            raise ValueError(f"{where} has no column {name!r}; its columns are {', '.join(header)}")
    for number, row in rows:
        if None in row or None in row.values():
            raise ValueError(f"{where}, line {number}: expected {len(header)} values as in the header")
    return [row for _, row in rows]


def header_of(source: Source, file: str) -> list[str]:
    """The column names in the first line of a CSV file, or none if it is not text."""
    try:
        return [name.strip() for name in source.read_text(file).split("\n", 1)[0].split(",")]
    except (ValueError, OSError):
        return []


def read_list(
    source: Source, file: str, row: str, expected: str, header: str | None = None
) -> list[tuple[int, tuple[str, ...]]]:
    """The lines of a list, each as its number and the groups of the pattern ``row``; empty ones are left out.

    A line that fits neither that nor, as the first, the pattern ``header`` is an error with ``expected``.
    """
    rows = []
    for number, line in enumerate(map(str.strip, source.read_text(file).splitlines() or [""]), 1):
        is_header = number == 1 and header is not None
        match = re.fullmatch((header or row) if number == 1 else row, line)
        if match is None and (line or is_header):
            raise ValueError(f"{file} in {source.path}, line {number}: expected {expected}, got {line!r}")
        if match is not None and not is_header:
            rows.append((number, match.groups()))
    return rows
