"""The file a FeatureTable lives in: parquet that any tool reads.

Column ``file``, one list column of float32 per factor, then the label columns; the file's metadata has as
JSON which is which, and the origin. Without it (files made elsewhere) list columns are factors.
"""

import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from pydantic import TypeAdapter

from derender.data import opened_parquet
from derender.features.table import FeatureTable, named
from derender.storage.atomic import atomic_file
from derender.storage.bounded import parse_json

FORMAT = 1
METADATA_KEY = b"derender"
_LISTS = pa.ListType, pa.LargeListType, pa.FixedSizeListType


def refuse_folder(path: Path) -> None:
    """ValueError where a table would be written onto a folder."""
    if path.is_dir():
        raise ValueError(f"{path} is a folder: name a file to write, such as {path / 'features.parquet'}")


def write_tables(path: Path, groups: Iterable[FeatureTable]) -> None:
    """Write a table that need never be whole in memory, each of ``groups`` as a row group.

    All groups have the same factors, labels and origin. At ``path`` stands the old file or the whole new one.
    """
    refuse_folder(path)
    with atomic_file(path, durable=True) as temporary, ExitStack() as stack:
        writer = None
        for group in groups:
            table = as_arrow(group)
            if writer is None:
                labels: Any = list(group.labels)  # a dictionary of features or names helps nothing
                how = {"use_dictionary": labels, "write_page_checksum": True}
                writer = stack.enter_context(pq.ParquetWriter(temporary, table.schema, **how))
            writer.write_table(table.cast(writer.schema))
            del table
            pa.default_memory_pool().release_unused()


def as_arrow(content: FeatureTable) -> pa.Table:
    """The columns as they stand in the file, with what describes them."""
    columns: dict[str, pa.Array] = {"file": pa.array(content.files, pa.string())}
    columns |= {name: factor_column(values) for name, values in content.factors.items()}
    for name, values in content.labels.items():
        plain = values.tolist() if values.dtype.kind in "UO" else values
        try:
            columns[name] = pa.array(plain, from_pandas=True)
        except pa.ArrowException as error:
            raise ValueError(f"label {name!r} mixes kinds that no column holds ({error})") from error
    names = {"factors": list(content.factors), "labels": list(content.labels)}
    described = {"format": FORMAT, **names, "origin": dict(content.origin)}
    metadata = {METADATA_KEY: json.dumps(described, ensure_ascii=False).encode()}
    return pa.table(columns).replace_schema_metadata(metadata)


def factor_column(values: np.ndarray) -> pa.Array:
    """(N, D) numbers as N lists of D float32."""
    flat = pa.array(np.ascontiguousarray(values, np.float32).reshape(-1))
    return pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def read_table(path: Path, only: str | None = None) -> FeatureTable:
    """Read a feature table's file, ours or a similar one made elsewhere: all its factors, or ``only`` one."""
    if not path.is_file():
        raise FileNotFoundError(f"no feature table at {path}: make one with 'derender embed --out {path}'")
    with _readable(path):
        opened = opened_parquet(path)
        schema = opened.schema_arrow
    described = _described(schema.metadata, path)
    lists = [name for name in schema.names if name != "file" and isinstance(schema.field(name).type, _LISTS)]
    names = described.get("factors", lists)
    factors = names if only is None else [named(dict.fromkeys(names, only), only, "factor")]
    with _readable(path):
        table = opened.read([name for name in schema.names if name not in names or name in factors])
    others = [name for name in table.column_names if name != "file"]
    if len(others) == len(table.column_names):
        it_has = f"it has {', '.join(others) or 'no columns'}"
        raise ValueError(f"{path} has no column 'file' ({it_has}): add one with the images' names")
    labels = described.get("labels", [name for name in others if name not in factors])
    if not factors:
        raise ValueError(f"{path} has no column of lists, so no features: make it with 'derender embed'")
    for name in (*factors, *labels):
        if name not in others:
            raise ValueError(f"{path} lacks the column {name!r} that its metadata names: make it again")
    values = {name: factor_values(table.column(name), name, path) for name in factors}
    known = {name: _label(table.column(name)) for name in labels}
    files = tuple(map(str, table.column("file").to_pylist()))
    try:
        return FeatureTable(files, values, known, described.get("origin", {}))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except (pa.ArrowException, OSError) as error:
        raise ValueError(f"{path} is not a readable parquet file: make it with 'derender embed'") from error
    except ValueError as error:
        raise ValueError(f"{path} is damaged ({error}): make it again with 'derender embed'") from error


def _described(metadata: Mapping[bytes, bytes] | None, path: Path) -> dict[str, Any]:
    text = (metadata or {}).get(METADATA_KEY)
    if text is None:
        return {}
    try:
        described = parse_json(text, dict[str, Any])
        version = TypeAdapter(int).validate_python(described.get("format"))
    except ValueError as error:
        raise ValueError(f"the metadata of {path} is damaged: make it again with 'derender embed'") from error
    if version > FORMAT:
        raise ValueError(f"{path} has format {version}, this version reads up to {FORMAT}: update derender")
    return described


def factor_values(column: pa.ChunkedArray, name: str, path: Path) -> np.ndarray:
    """A column of equally long lists of numbers as (N, D) float32."""
    where = f"{path}: factor {name!r}"
    if not isinstance(column.type, _LISTS):
        raise ValueError(f"{where} is a column of {column.type}, expected a list of numbers in each row")
    if column.null_count:
        raise ValueError(f"{where} is empty in {column.null_count} rows: drop these rows")
    value_type = column.type.value_type
    if not (pa.types.is_floating(value_type) or pa.types.is_integer(value_type)):
        raise ValueError(f"{where} holds {value_type}, expected numbers")
    widths = sorted(pc.call_function("list_value_length", [column]).unique().to_pylist())
    if len(widths) > 1:
        raise ValueError(f"{where} has rows of different lengths ({widths[0]} to {widths[-1]})")
    parts = [chunk.flatten().to_numpy(zero_copy_only=False).astype(np.float32) for chunk in column.chunks]
    flat = np.concatenate([np.zeros(0, np.float32), *parts])
    return flat.reshape(len(column), widths[0] if widths else 1)


def _label(column: pa.ChunkedArray) -> np.ndarray:
    """Numbers and texts as their own kinds; what is missing is NaN among floats, None elsewhere."""
    kind, whole = column.type, column.null_count == 0
    if pa.types.is_floating(kind) or (whole and (pa.types.is_integer(kind) or pa.types.is_boolean(kind))):
        return column.to_numpy()
    if whole and (pa.types.is_string(kind) or pa.types.is_large_string(kind)):
        return np.array(column.to_pylist(), dtype=str)
    values = np.empty(len(column), dtype=object)
    values[:] = column.to_pylist()
    return values
