"""Images and labels from a table: CSV or Parquet, one row for each image.

``data.csv`` (or metadata.csv, data.parquet, metadata.parquet) beside the images, in a folder or a zip;
or any table of that kind given in place of a folder. Paths are relative to the table, and none leaves its
folder. One column, named file, path, image, file_name or filename, holds them; every other column is a
label:

- a column ``split`` or ``partition`` of nothing but train, val, test and the like is the official split;
- true and false, yes and no, or 0 and 1 only: a yes/no attribute;
- numbers are numbers, unless they are names in disguise: leading zeros, or whole numbers that a float32
  cannot hold;
- anything else is text. Empty cells are unknown.
"""

import csv
import io
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Int64

from derender.data.layouts.layout import (
    PARTITION_NAMES,
    Layout,
    Table,
    images_of,
    number_column,
    part_of,
    read_csv,
    text_column,
)
from derender.data.names import is_image
from derender.data.parquet import check_lists, checked_footer
from derender.data.source import Skipped, Source, read_bounded, stamps_of

TABLE_SUFFIXES = (".csv", ".parquet")
PATH_COLUMNS = ("file", "path", "image", "file_name", "filename")

_NAMES = ("data.csv", "data.parquet", "metadata.csv", "metadata.parquet")
_UNSAFE = re.compile(r"^[/\\]|^[A-Za-z]:|(^|[/\\])\.\.([/\\]|$)")  # absolute, or out of the folder
_YES, _NO = ("true", "yes", "1"), ("false", "no", "0")

Cells = tuple[list[str], Sequence[Mapping[str, str]]]
"""The columns' names and the rows of a table, every cell as text ("" for none)."""


class TableSource(Source):
    """The images that a table on disk names, and the table itself."""

    def __init__(self, path: Path):
        self.path = path
        self.table = path.name
        self._folder = path.parent
        self.files = (self.table,)
        _, paths, _ = _columns(self, self.table)
        there = {file for file in paths if is_image(file) and self._is_file(file)}
        self.files = tuple(sorted({self.table, *there}))

    def _is_file(self, file: str) -> bool:
        try:
            return (self._folder / file).is_file()
        except (OSError, ValueError):
            return False

    def read(self, file: str) -> bytes:
        return read_bounded(self._folder / file)

    def stamps(self, files: Sequence[str]) -> Int64[np.ndarray, "n 2"]:
        return stamps_of([self._folder / file for file in files])


def is_table(path: Path) -> bool:
    """Whether a path names a table rather than a folder, a zip or an image."""
    return path.suffix.lower() in TABLE_SUFFIXES and path.is_file()


def holds_paths(path: Path) -> bool:
    """Whether a Parquet file on disk is such a table, and not one that holds the images themselves."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        schema = pq.read_schema(path)
    except (pa.ArrowException, OSError):
        return False
    return not _not_cells(schema) and any(name.lower() in PATH_COLUMNS for name in schema.names)


def _table_of(source: Source) -> str | None:
    return source.table if isinstance(source, TableSource) else source.named(*_NAMES)


def _is_listed(source: Source) -> bool:
    """Whether there is a table with a column of paths: a metadata.csv may be about something else."""
    if isinstance(source, TableSource):
        return True
    file = _table_of(source)
    if file is None or not source.images:
        return False
    try:
        return bool(set(_cells(source, file)[0]) & set(PATH_COLUMNS))
    except ValueError:
        return PurePosixPath(file).stem == "data"


def _read_listed(source: Source, subset: str | None) -> Table:
    """The rows whose image is there; those whose image is not are listed as skipped."""
    file = _table_of(source)
    if file is None:
        raise ValueError(f"{source.path} has no table of its images: expected {', '.join(_NAMES)}")
    column, paths, columns = _columns(source, file)
    images = set(source.images)
    rows = [row for row, path in enumerate(paths) if path in images]
    missing = f"named in {file}, but no image of that name is there"
    skipped = tuple(Skipped(path, missing) for path in paths if path not in images)
    if not rows:
        first = f": the first is {paths[0]!r}" if paths else ""
        raise ValueError(
            f"the column {column!r} of {file} in {source.path} names no image that is there{first}; "
            f"paths are relative to the table"
        )
    partition, labels = None, {}
    for name, values in columns.items():
        values = [values[row] for row in rows]
        parts = {value.lower() for value in values}
        if name.lower() in ("split", "partition") and parts <= {*PARTITION_NAMES, ""}:
            partition = text_column(PARTITION_NAMES.get(value.lower(), "") for value in values)
        else:
            labels[name] = label_column(values)
    table = Table(tuple(paths[row] for row in rows), labels, partition, skipped=skipped)
    if subset is not None and (partition is None or subset.lower() not in PARTITION_NAMES):
        inside = set(images_of(source, subset))
        return table.select(np.array([row for row, path in enumerate(table.files) if path in inside], int))
    return part_of(table, source, subset, f"a column split in {file}")


def label_column(values: Sequence[str]) -> np.ndarray:
    """A column of cells as yes/no (int8), numbers (float32) or text, whichever holds all of them."""
    cells = [value.strip().lower() for value in values]
    known = set(cells) - {""}
    if known and known <= {*_YES, *_NO}:
        return np.array([1 if cell in _YES else 0 if cell in _NO else -1 for cell in cells], np.int8)
    if known and all(_is_number(cell) for cell in known):
        return number_column(float(cell or "nan") for cell in cells)
    return text_column(value.strip() for value in values)


def _is_number(value: str) -> bool:
    digits = value.lstrip("-")
    if digits.isdecimal() and (digits != str(int(digits)) or int(digits) > 2**24):
        return False
    try:
        return math.isfinite(float(value)) or value == "nan"
    except ValueError:
        return False


def _columns(source: Source, file: str) -> tuple[str, list[str], dict[str, list[str]]]:
    """The name of the column of paths, the paths relative to the source, and the other columns."""
    header, rows = _cells(source, file)
    column = next((name for known in PATH_COLUMNS for name in header if name.lower() == known), None)
    if column is None:
        raise ValueError(
            f"{file} in {source.path} has no column of paths ({', '.join(PATH_COLUMNS)}); "
            f"its columns are {', '.join(header)}"
        )
    folder = str(PurePosixPath(file).parent)
    paths: dict[str, None] = {}
    for number, row in enumerate(rows, 1):
        path = str(PurePosixPath(folder, row[column].replace("\\", "/")))
        if not row[column] or _UNSAFE.search(row[column]):
            raise ValueError(
                f"{file} in {source.path}, row {number}: expected a path relative to the table and below it, "
                f"got {row[column]!r}"
            )
        if path in paths:
            raise ValueError(f"{file} in {source.path}, row {number}: {path!r} is there twice")
        paths[path] = None
    others = [name for name in header if name and name != column]
    return column, list(paths), {name: [row[name] for row in rows] for name in others}


def _cells(source: Source, file: str) -> Cells:
    if file.lower().endswith(".parquet"):
        return _parquet_cells(source, file)
    if rows := read_csv(source, file):
        return list(rows[0]), rows
    return next(csv.reader(io.StringIO(source.read_text(file))), []), []


def _parquet_cells(source: Source, file: str) -> Cells:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        content = source.read(file)
        footer = checked_footer(io.BytesIO(content), len(content))
        opened = pq.ParquetFile(io.BytesIO(content))
        check_lists(footer, opened.schema_arrow, len(content))
        table = opened.read()
    except (pa.ArrowException, OSError) as problem:
        raise ValueError(f"{file} in {source.path} is no Parquet table ({problem})") from problem
    except ValueError as problem:
        raise ValueError(f"{file} in {source.path} is damaged ({problem}): restore it") from problem
    if nested := _not_cells(table.schema):
        raise ValueError(
            f"column {nested[0]!r} of {file} in {source.path} holds {table.schema.field(nested[0]).type}; "
            f"expected paths, numbers and text (images kept inside a table are not read)"
        )
    cells = {name: [_text(cell) for cell in table[name].to_pylist()] for name in table.column_names}
    return list(cells), [dict(zip(cells, row, strict=True)) for row in zip(*cells.values(), strict=True)]


def _not_cells(schema: Any) -> list[str]:
    """The columns of a Parquet table that hold more than a number or a text."""
    import pyarrow as pa

    return [one.name for one in schema if pa.types.is_nested(one.type) or pa.types.is_binary(one.type)]


def _text(cell: object) -> str:
    return "" if cell is None or (isinstance(cell, float) and math.isnan(cell)) else str(cell)


TABLE = Layout("table", "a table of paths and labels (CSV or Parquet)", "", _is_listed, _read_listed)
