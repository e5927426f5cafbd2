"""A parquet file, opened only if what its footer claims can be.

Readers reserve memory for as many rows as the footer names: one changed byte of a file of 2 kB can ask for
18 GB. Leaves out the pages behind the footer, and the columns of single row groups: of a damaged footer
pyarrow 26 looks at those with C++ exceptions that end the process.
"""

from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

ALWAYS_ALLOWED_BYTES = 512 * 2**20
MOST_EXPANSION = 1000
"""Of features that are all the same some files expand hundreds of times, of real ones not ten times."""


def opened_parquet(file: Path | bytes) -> "pq.ParquetFile":
    """The file, or content of a file, opened and not yet read.

    Raises:
        pyarrow.ArrowException, OSError: it is no parquet file.
        ValueError: its numbers of rows contradict each other, or its values need more than 512 MiB and more
            than 1000 times the file's size.
    """
    import pyarrow.parquet as pq

    size = len(file) if isinstance(file, bytes) else file.stat().st_size
    source = BytesIO(file) if isinstance(file, bytes) else file
    opened = pq.ParquetFile(source, page_checksum_verification=True)
    groups = [opened.metadata.row_group(place).num_rows for place in range(opened.metadata.num_row_groups)]
    rows = opened.metadata.num_rows
    if min(groups, default=0) < 0 or sum(groups) != rows:
        raise ValueError(f"{rows:,} rows, its parts have {sum(groups):,}")
    taken = rows * sum(map(_bytes_of, opened.schema_arrow.types))
    if taken > max(ALWAYS_ALLOWED_BYTES, MOST_EXPANSION * size):
        raise ValueError(f"{taken:,} bytes of values in a file of {size:,}")
    return opened


def _bytes_of(kind: "pa.DataType") -> int:
    """Bytes that a value of this kind takes: a text and a list of any length count as one number."""
    import pyarrow as pa

    if pa.types.is_fixed_size_list(kind):
        return kind.list_size * _bytes_of(kind.value_type)
    if pa.types.is_struct(kind):
        return sum(_bytes_of(field.type) for field in kind)
    return kind.byte_width if pa.types.is_fixed_size_binary(kind) else 8
