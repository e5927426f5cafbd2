"""What the footer of a parquet file claims, held against the file before memory is taken for it.

Readers reserve memory for as many rows as the footer names: one changed byte of a file of 2 kB can ask for
18 GB. Leaves out the pages behind the footer.
"""

from io import BufferedIOBase
from typing import TYPE_CHECKING

from derender.data.parquet_footer import BOOLEAN, FLOAT, INT32, INT96, Footer, read_footer

if TYPE_CHECKING:
    import pyarrow as pa

ALWAYS_ALLOWED_BYTES = 512 * 2**20
MOST_EXPANSION = 1000
"""Of features that are all the same some files expand hundreds of times, of real ones not ten times."""

_WIDTHS = {BOOLEAN: 1, INT32: 4, FLOAT: 4, INT96: 12}


def checked_footer(file: BufferedIOBase, size: int) -> Footer:
    """The footer of a file of ``size`` bytes, if all that it claims can be.

    Raises:
        ValueError: what cannot be, in words: numbers of rows and values that contradict each other, sizes
            beyond the file's, and values that would take more than 512 MiB and more than 1000 times the size
            of the file.
    """
    claimed = read_footer(file, size)
    compressed = taken = 0
    for group in claimed.groups:
        if group.rows < 0:
            raise ValueError(f"{group.rows:,} rows")
        if len(group.chunks) != len(claimed.leaves):
            raise ValueError(f"{len(group.chunks)} columns where the schema has {len(claimed.leaves)}")
        for leaf, chunk in zip(claimed.leaves, group.chunks, strict=True):
            fits = chunk.values >= group.rows if leaf.repeated else chunk.values == group.rows
            if not fits:
                raise ValueError(f"{chunk.values:,} values of {leaf.name} in {group.rows:,} rows")
            if min(chunk.compressed, chunk.uncompressed) < 0:
                raise ValueError(f"a size of {leaf.name} below zero")
            compressed += chunk.compressed
            taken += max(chunk.values * _WIDTHS.get(leaf.kind, max(8, leaf.length)), chunk.uncompressed)
    rows = sum(group.rows for group in claimed.groups)
    if rows != claimed.rows:
        raise ValueError(f"{claimed.rows:,} rows, its parts have {rows:,}")
    if compressed > size:
        raise ValueError(f"{compressed:,} bytes of columns in a file of {size:,}")
    _bounded(taken, size)
    return claimed


def check_lists(footer: Footer, schema: "pa.Schema", size: int) -> None:
    """Lists of a fixed length, of which a footer counts nothing, against the size of the file.

    Raises:
        ValueError: they would take too much.
    """
    import pyarrow as pa

    widest = [kind.list_size for kind in schema.types if pa.types.is_fixed_size_list(kind)]
    _bounded(4 * footer.rows * sum(widest), size)


def _bounded(taken: int, size: int) -> None:
    if taken > max(ALWAYS_ALLOWED_BYTES, MOST_EXPANSION * size):
        raise ValueError(f"{taken:,} bytes of values in a file of {size:,}")
