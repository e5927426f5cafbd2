"""Parquet footers: what pyarrow finds in good ones; false counts are refused before memory is taken."""

import io
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from derender.data import check_lists, checked_footer, list_images
from derender.data.parquet import ALWAYS_ALLOWED_BYTES, _leaves, _Reader
from derender.features import FeatureTable

ROWS, WIDTH = 3, 4
CLAIMED = 2**26
"""Enough to be seen: where nothing is bounded, this many rows take 650 MB for a file of 2 kB."""


def written(table: pa.Table, **how) -> bytes:
    stream = io.BytesIO()
    pq.write_table(table, stream, **how)
    return stream.getvalue()


@pytest.fixture
def table(tmp_path) -> Path:
    numbers = np.random.default_rng(0)
    return FeatureTable(
        ("a", "b", "c"),
        {"geometry": numbers.normal(size=(ROWS, WIDTH))},
        {"age": np.array([1.0, 2, 3]), "name": np.array(["x", "y", "z"])},
    ).write(tmp_path / "F.parquet")


def number(value: int) -> bytes:
    """A 64-bit field right behind the one before it, as Thrift's compact protocol writes it."""
    value, out = (2 * value if value >= 0 else -2 * value - 1), b"\x16"
    while value > 127:
        out += bytes([value & 127 | 128])
        value >>= 7
    return out + bytes([value])


def with_claims(content: bytes, old: int, new: int, which: list[int] | None = None) -> bytes:
    """A file in whose footer some of the places where ``old`` stands as a 64-bit number say ``new``."""
    length = int.from_bytes(content[-8:-4], "little")
    body, footer = content[: -8 - length], content[-8 - length : -8]
    pieces = footer.split(number(old))
    changed = pieces[0]
    for place, piece in enumerate(pieces[1:]):
        changed += number(new if which is None or place in which else old) + piece
    return body + changed + len(changed).to_bytes(4, "little") + b"PAR1"


def claim(content: bytes) -> str | None:
    stream = io.BytesIO(content)
    try:
        footer = checked_footer(stream, len(content))
        check_lists(footer, pq.ParquetFile(stream).schema_arrow, len(content))
    except ValueError as problem:
        return str(problem)
    return None


def damaged(content: bytes, old: int, new: int) -> dict[int, bytes]:
    """One file for each place where a number stands."""
    places = content[-8 - int.from_bytes(content[-8:-4], "little") :].count(number(old))
    return {place: with_claims(content, old, new, [place]) for place in range(places)}


def test_features_that_are_all_the_same_are_read(tmp_path):
    constant = FeatureTable(tuple(map(str, range(20_000))), {"f": np.zeros((20_000, 64))})
    path = constant.write(tmp_path / "constant.parquet")
    assert 10 * path.stat().st_size < 20_000 * 64 * 4
    assert FeatureTable.read(path).factors["f"].shape == (20_000, 64)


def test_the_row_count_that_made_the_reader_ask_for_eighteen_gigabytes_is_refused(table):
    whole = table.read_bytes()
    asked = {
        place: content
        for place, content in damaged(whole, ROWS, CLAIMED).items()
        if pq.ParquetFile(io.BytesIO(content)).metadata.row_group(0).num_rows == CLAIMED
    }
    assert len(asked) == 1
    (content,) = asked.values()
    before = pa.default_memory_pool().max_memory()
    table.write_bytes(content)
    with pytest.raises(ValueError, match=r"F.parquet is damaged \(3 values of file in 67,108,864 rows\)"):
        FeatureTable.read(table)
    assert pa.default_memory_pool().max_memory() - before < 2**24


def test_counts_and_sizes_that_agree_are_held_against_the_size_of_the_file(table):
    whole, rows = table.read_bytes(), ALWAYS_ALLOWED_BYTES // 8
    content = with_claims(with_claims(whole, ROWS, rows), ROWS * WIDTH, rows * WIDTH)
    assert "bytes of values in a file of" in (claim(content) or "")
    sizes = pq.ParquetFile(io.BytesIO(whole)).metadata.row_group(0).column(1).total_compressed_size
    told = " ".join(str(claim(content)) for content in damaged(whole, sizes, 10**6).values())
    assert "bytes of columns in a file of" in told
    told = {claim(content) for content in damaged(whole, sizes, -1).values()}
    assert "a size of geometry.list.element below zero" in told


def test_a_list_of_images_is_held_to_the_same(tmp_path):
    path, three = tmp_path / "labels.parquet", {"path": ["a.png", "b.png", "c.png"], "age": [1, 2, 3]}
    path.write_bytes(with_claims(written(pa.table(three)), 3, CLAIMED, None))
    with pytest.raises(ValueError, match=r"labels.parquet .* is damaged \("):
        list_images(path)


def footer_of(content: bytes) -> int:
    return checked_footer(io.BytesIO(content), len(content))


@pytest.fixture(scope="module")
def columns() -> pa.Table:
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


HOW = [
    {"row_group_size": 7},
    {"compression": "zstd", "write_statistics": False},
    {"write_page_index": True, "write_page_checksum": True, "version": "1.0"},
    {"sorting_columns": [pq.SortingColumn(0)], "use_dictionary": False},
    {"bloom_filter_options": {"file": {"ndv": 40}}},
]


@pytest.mark.parametrize("how", HOW)
def test_good_footers_say_what_pyarrow_finds_in_them(columns, how):
    try:
        content = written(columns, **how)
    except TypeError:
        pytest.skip(f"this pyarrow cannot write {how}")
    expected = pq.ParquetFile(io.BytesIO(content)).metadata
    assert footer_of(content) == expected.num_rows == 40
    length = int.from_bytes(content[-8:-4], "little")
    found = _Reader(content[-8 - length : -8]).struct()
    columns = [expected.schema.column(number) for number in range(expected.num_columns)]
    assert [(name, repeated) for name, _, repeated in _leaves(found[2])] == [
        (column.path, column.max_repetition_level > 0) for column in columns
    ]
    for place, group in enumerate(found[4]):
        theirs = expected.row_group(place)
        for number, column in enumerate(group[1]):
            one = theirs.column(number)
            sizes = (one.num_values, one.total_uncompressed_size, one.total_compressed_size)
            assert tuple(column[3][field] for field in (5, 6, 7)) == sizes


def test_no_footer_is_told_from_a_damaged_one(columns):
    content = written(columns)
    for none in (b"", b"PAR1", b"text" * 10, content[:-1], content[:-4] + b"PARE"):
        with pytest.raises(OSError, match="no parquet footer"):
            footer_of(none)
    length = int.from_bytes(content[-8:-4], "little")
    body, footer = content[: -8 - length], content[-8 - length : -8]
    for shorter in (0, 1, length // 3, length - 1):
        with pytest.raises(ValueError):
            footer_of(body + footer[:shorter] + shorter.to_bytes(4, "little") + b"PAR1")


def test_nested_without_end_is_refused():
    lists = (b"", b"\x1c"), (b"", b"\x19\x1c"), (b"", b"\x1b\1\xcc"), (b"", b"\x19"), (b"\x1b", b"\1\xbb")
    for first, one in lists:
        nested = first + one * 5_000
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
