"""Images and labels from a table, CSV or Parquet: one row for each image (docs/reference/data-sets.md).

Paths are relative to the table, and none leaves its folder. A column ``split`` or ``partition`` of nothing
but train, val, test and the like is the official split. True and false, yes and no, or 0 and 1 only are a
yes/no attribute. Numbers are numbers, unless they are names in disguise: leading zeros, or whole numbers that
a float32 cannot hold. Anything else is text. Empty cells are unknown.
"""

import math
import os
import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from derender.data.layouts.layout import PARTITION_NAMES, Table, header_of, read_csv, text_column
from derender.data.source import FileSource, Skipped, Source, is_image, opened_parquet

TABLE_SUFFIXES = (".csv", ".parquet")
PATH_COLUMNS = ("file", "path", "image", "file_name", "filename")

_NAMES = ("data.csv", "data.parquet", "metadata.csv", "metadata.parquet")
_UNSAFE = re.compile(r"^[/\\]|^[A-Za-z]:|(^|[/\\])\.\.([/\\]|$)")  # absolute, or out of the folder
_YES, _NO = ("true", "yes", "1"), ("false", "no", "0")


class TableSource(FileSource):
    """The images that a table on disk names, and the table itself."""

    def __init__(self, path: Path):
        super().__init__(path)
        self.table = path.name
        _, paths, _ = _columns(self, self.table)
        there = [file for file in filter(is_image, paths) if os.path.isfile(self.on_disk(file))]  # noqa: PTH113
        self.files = tuple(sorted({self.table, *there}))  # Path.is_file raises where a path is too long


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


def is_listed(source: Source) -> bool:
    """Whether there is a table with a column of paths: a metadata.csv may be about something else."""
    file = _table_of(source)
    if isinstance(source, TableSource) or file is None or not source.images:
        return isinstance(source, TableSource)
    try:
        names = ";".join(_cells(source, file)).lower()  # which other signs than commas may part
        return not {*PATH_COLUMNS}.isdisjoint(re.split("[;\t]", names))
    except ValueError:
        return PurePosixPath(file).stem == "data"


def load_listed(source: Source) -> Table | None:
    """The rows whose image is there; those whose image is not are listed as skipped."""
    if (file := _table_of(source)) is None:
        return None
    column, paths, columns = _columns(source, file)
    images = set(source.images)
    rows = [row for row, path in enumerate(paths) if path in images]
    missing = f"named in {file}, but no image of that name is there"
    skipped = tuple(Skipped(path, missing) for path in paths if path not in images)
    if not rows:
        first = f": the first is {paths[0]!r}" if paths else ""
        what = f"the column {column!r} of {file} in {source.path} names no image that is there"
        raise ValueError(f"{what}{first}; paths are relative to the table")
    partition, labels = None, {}
    for name, values in columns.items():
        values = [values[row] for row in rows]
        if name.lower() in ("split", "partition") and {*map(str.lower, values)} <= {*PARTITION_NAMES, ""}:
            partition = text_column(PARTITION_NAMES.get(value.lower(), "") for value in values)
        else:
            labels[name] = label_column(values)
    return Table(tuple(paths[row] for row in rows), labels, partition, skipped=skipped)


def label_column(values: Sequence[str]) -> np.ndarray:
    """A column of cells as yes/no (int8), numbers (float32) or text, whichever holds all of them."""
    cells = [value.strip().lower() for value in values]
    known = set(cells) - {""}
    if known and known <= {*_YES, *_NO}:
        return np.array([1 if cell in _YES else 0 if cell in _NO else -1 for cell in cells], np.int8)
    if known and all(map(_is_number, known)):
        return np.array([float(cell or "nan") for cell in cells], np.float32)
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
    cells, where = _cells(source, file), f"{file} in {source.path}"
    column = next((name for known in PATH_COLUMNS for name in cells if name.lower() == known), None)
    if column is None:
        known = f"its columns are {', '.join(cells)}"
        raise ValueError(f"{where} has no column of paths ({', '.join(PATH_COLUMNS)}); {known}")
    folder = str(PurePosixPath(file).parent)
    paths: dict[str, None] = {}
    for number, written in enumerate(cells.pop(column), 1):
        path = str(PurePosixPath(folder, written.replace("\\", "/")))
        if not written or _UNSAFE.search(written):
            expected = "expected a path relative to the table and below it"
            raise ValueError(f"{where}, row {number}: {expected}, got {written!r}")
        if path in paths:
            raise ValueError(f"{where}, row {number}: {path!r} is there twice")
        paths[path] = None
    return column, list(paths), {name: values for name, values in cells.items() if name}


def _cells(source: Source, file: str) -> dict[str, list[str]]:
    """The columns of a table, every cell as text ("" for none)."""
    if not file.lower().endswith(".parquet"):
        rows = read_csv(source, file)
        return {name: [row[name] for row in rows] for name in (rows[0] if rows else header_of(source, file))}
    import pyarrow as pa

    where = f"{file} in {source.path}"
    try:
        table = opened_parquet(source.read(file)).read()
    except (pa.ArrowException, OSError) as problem:
        raise ValueError(f"{where} is no Parquet table ({problem})") from problem
    except ValueError as problem:
        raise ValueError(f"{where} is damaged ({problem}): restore it") from problem
    if nested := _not_cells(table.schema):
        column = table.schema.field(nested[0])
        expected = "expected paths, numbers and text (images kept inside a table are not read)"
        raise ValueError(f"column {column.name!r} of {where} holds {column.type}; {expected}")
    cells = {name: table[name].to_pylist() for name in table.column_names}
    return {name: ["" if one is None or one != one else str(one) for one in cells[name]] for name in cells}


def _not_cells(schema: Any) -> list[str]:
    """The columns of a Parquet table that hold more than a number or a text."""
    import pyarrow as pa

    return [one.name for one in schema if pa.types.is_nested(one.type) or pa.types.is_binary(one.type)]
