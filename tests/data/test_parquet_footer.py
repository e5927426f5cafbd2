"""Parquet footers read by ourselves: what pyarrow finds in good ones, one error for every bad one."""

import io

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from derender.data.parquet_footer import Footer, read_footer
from derender.features import FeatureTable


def written(table: pa.Table, **how) -> bytes:
    stream = io.BytesIO()
    pq.write_table(table, stream, **how)
    return stream.getvalue()


def footer_of(content: bytes) -> Footer:
    return read_footer(io.BytesIO(content), len(content))


@pytest.fixture(scope="module")
def table() -> pa.Table:
    rows = 40
    return pa.table(
        {
            "file": [f"{row}.png" for row in range(rows)],
            "yes": [row % 2 == 0 for row in range(rows)],
            "age": pa.array([None if row % 3 else row for row in range(rows)], pa.int32()),
            "when": pa.array([row / 3 for row in range(rows)]),
            "fixed": pa.array([b"abcde"] * rows, pa.binary(5)),
            "code": pa.array([[1.0, 2.0, 3.0]] * rows, pa.list_(pa.float32(), 3)),
            "deep": pa.array([{"a": [row] * (row % 4), "b": "x"} for row in range(rows)]),
            "by_name": pa.array([[("k", row)] for row in range(rows)], pa.map_(pa.string(), pa.int64())),
        }
    )


@pytest.mark.parametrize(
    "how",
    [
        {},
        {"row_group_size": 7},
        {"compression": "zstd", "write_statistics": False},
        {"write_page_index": True, "write_page_checksum": True, "version": "1.0"},
        {"sorting_columns": [pq.SortingColumn(0)], "use_dictionary": False},
        {"bloom_filter_options": {"file": {"ndv": 40}}},
    ],
)
def test_good_footers_say_what_pyarrow_finds_in_them(table, how):
    try:
        content = written(table, **how)
    except TypeError:
        pytest.skip(f"this pyarrow cannot write {how}")
    found, expected = footer_of(content), pq.ParquetFile(io.BytesIO(content)).metadata
    assert found.rows == expected.num_rows == 40
    assert len(found.groups) == expected.num_row_groups
    names = [expected.schema.column(number).path for number in range(expected.num_columns)]
    assert [leaf.name for leaf in found.leaves] == names
    for number, leaf in enumerate(found.leaves):
        kind = expected.schema.column(number)
        assert leaf.repeated == (kind.max_repetition_level > 0)
        assert leaf.length == (5 if leaf.name == "fixed" else 0)
    for place, group in enumerate(found.groups):
        theirs = expected.row_group(place)
        assert group.rows == theirs.num_rows
        for number, chunk in enumerate(group.chunks):
            column = theirs.column(number)
            assert chunk.values == column.num_values
            assert chunk.compressed == column.total_compressed_size
            assert chunk.uncompressed == column.total_uncompressed_size


def test_no_footer_is_told_from_a_damaged_one(table):
    content = written(table)
    for none in (b"", b"PAR1", b"text" * 10, content[:-1], content[:-4] + b"PARE"):
        with pytest.raises(OSError, match="no parquet footer"):
            footer_of(none)
    length = int.from_bytes(content[-8:-4], "little")
    for shorter in (0, 1, length // 3, length - 1):
        with pytest.raises(ValueError):
            footer_of(
                content[: -8 - length]
                + content[-8 - length :][:shorter]
                + shorter.to_bytes(4, "little")
                + b"PAR1"
            )


def test_every_changed_byte_is_refused_or_read_and_never_more_than_that(table):
    content = written(table)
    length = int.from_bytes(content[-8:-4], "little")
    draw, refused = np.random.default_rng(0), 0
    for place in draw.integers(len(content) - 8 - length, len(content) - 8, 600):
        changed = bytearray(content)
        changed[place] = draw.integers(256)
        try:
            footer_of(bytes(changed))
        except ValueError:
            refused += 1
    assert refused > 60


def test_nested_without_end_is_refused():
    lists = b"\x19" * 5_000
    for nested in (
        b"\x1c" * 5_000,
        b"\x19\x1c" * 5_000,
        b"\x1b\x01\xcc" * 5_000,
        lists,
        b"\x1b" + b"\1\xbb" * 5_000,
    ):
        with pytest.raises(ValueError, match="nested too deeply"):
            footer_of(b"PAR1" + nested + len(nested).to_bytes(4, "little") + b"PAR1")


def test_a_histogram_that_fits_no_column_ends_no_process(tmp_path):
    """pyarrow 26 ends the process when it is asked for such a column's numbers."""
    rows = FeatureTable(("a", "b", "c"), {"geometry": np.ones((3, 4))}).write(tmp_path / "F.parquet")
    content = rows.read_bytes()
    optional, required = b"\x15\x0c\x25\x02\x18\x04file", b"\x15\x0c\x25\x00\x18\x04file"
    assert content.count(optional) == 1
    rows.write_bytes(content.replace(optional, required))
    with pytest.raises(ValueError, match=r"F.parquet is "):
        FeatureTable.read(rows)
