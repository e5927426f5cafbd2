"""What the footer of a parquet file claims, held against the file before memory is taken for it.

Readers reserve memory for as many rows as the footer names: one changed byte of a file of 2 kB can ask for
18 GB. Leaves out the pages behind the footer.
"""

import pyarrow as pa
import pyarrow.parquet as pq

ALWAYS_ALLOWED_BYTES = 512 * 2**20
MOST_EXPANSION = 1000
"""Of features that are all the same some files expand hundreds of times, of real ones not ten times."""

_WIDTHS = {"BOOLEAN": 1, "INT32": 4, "FLOAT": 4, "INT96": 12}


def false_claim(opened: pq.ParquetFile, size: int) -> str | None:
    """What cannot be in a footer, given the size of its file in bytes, in words; None where all can be.

    Numbers of rows and values that contradict each other, sizes beyond the file's, and values that would
    take more than 512 MiB and more than 1000 times the size of the file.
    """
    claimed, schema = opened.metadata, opened.schema_arrow
    rows = compressed = taken = 0
    for number in range(claimed.num_row_groups):
        group = claimed.row_group(number)
        rows += group.num_rows
        if group.num_rows < 0:
            return f"{group.num_rows:,} rows"
        for column in range(group.num_columns):
            chunk, kind = group.column(column), claimed.schema.column(column)
            values, name = chunk.num_values, chunk.path_in_schema
            fits = values >= group.num_rows if kind.max_repetition_level else values == group.num_rows
            if not fits:
                return f"{values:,} values of {name} in {group.num_rows:,} rows"
            if min(chunk.total_compressed_size, chunk.total_uncompressed_size) < 0:
                return f"a size of {name} below zero"
            compressed += chunk.total_compressed_size
            width = _WIDTHS.get(chunk.physical_type, max(8, kind.length))
            taken += max(values * width, chunk.total_uncompressed_size)
    if rows != claimed.num_rows:
        return f"{claimed.num_rows:,} rows, its parts have {rows:,}"
    if compressed > size:
        return f"{compressed:,} bytes of columns in a file of {size:,}"
    widest = [kind.list_size for kind in schema.types if pa.types.is_fixed_size_list(kind)]
    taken = max(taken, 4 * rows * sum(widest))
    if taken > max(ALWAYS_ALLOWED_BYTES, MOST_EXPANSION * size):
        return f"{taken:,} bytes of values in a file of {size:,}"
    return None
