"""Parquet footers: false claims are refused before memory is taken, and end no process."""

import io
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from derender.data import list_images, opened_parquet
from derender.features import FeatureTable

ROWS, CLAIMED = 3, 2**26
"""Enough to be seen: where nothing is bounded, this many rows take 650 MB for a file of 2 kB."""


@pytest.fixture
def table(tmp_path) -> Path:
    factors = {"geometry": np.random.default_rng(0).normal(size=(ROWS, 4))}
    made = FeatureTable(("a", "b", "c"), factors, {"age": np.array([1.0, 2, 3])})
    return made.write(tmp_path / "F.parquet")


def number(value: int) -> bytes:
    """A 64-bit field right behind the one before it, as Thrift's compact protocol writes it."""
    value, out = (2 * value if value >= 0 else -2 * value - 1), b"\x16"
    while value > 127:
        out += bytes([value & 127 | 128])
        value >>= 7
    return out + bytes([value])


def with_claims(content: bytes, old: int, new: int) -> list[bytes]:
    """A file for each place in the footer where ``old`` stands as a 64-bit number, and one for all."""
    length = int.from_bytes(content[-8:-4], "little")
    body, pieces = content[: -8 - length], content[-8 - length : -8].split(number(old))
    results = []
    for changed in [*({place} for place in range(1, len(pieces))), set(range(1, len(pieces)))]:
        rest = ((number(new if at in changed else old) + one) for at, one in enumerate(pieces[1:], 1))
        footer = pieces[0] + b"".join(rest)
        results.append(body + footer + len(footer).to_bytes(4, "little") + b"PAR1")
    return results


def test_features_that_are_all_the_same_are_read(tmp_path):
    constant = FeatureTable(tuple(map(str, range(20_000))), {"f": np.zeros((20_000, 64))})
    path = constant.write(tmp_path / "constant.parquet")
    assert 10 * path.stat().st_size < 20_000 * 64 * 4
    assert FeatureTable.read(path).factors["f"].shape == (20_000, 64)


@pytest.mark.parametrize("claimed", [CLAIMED, -1])
def test_the_row_count_that_made_the_reader_ask_for_eighteen_gigabytes_is_refused(table, claimed):
    before = pa.default_memory_pool().max_memory()
    whole, refused = table.read_bytes(), 0
    for content in with_claims(whole, ROWS, claimed):
        table.write_bytes(content)
        try:
            assert FeatureTable.read(table).files == ("a", "b", "c")  # a number that is never looked at
        except ValueError as problem:
            assert str(table) in str(problem)
            refused += "is damaged (" in str(problem)
    assert refused >= 2 and pa.default_memory_pool().max_memory() - before < 2**24


def test_counts_that_agree_are_held_against_the_size_of_the_file(table):
    with pytest.raises(ValueError, match="bytes of values in a file of"):
        opened_parquet(with_claims(table.read_bytes(), ROWS, CLAIMED)[-1])


def test_a_list_of_images_is_held_to_the_same(tmp_path):
    path, stream = tmp_path / "labels.parquet", io.BytesIO()
    pq.write_table(pa.table({"path": ["a.png", "b.png", "c.png"], "age": [1, 2, 3]}), stream)
    path.write_bytes(with_claims(stream.getvalue(), 3, CLAIMED)[-1])
    with pytest.raises(ValueError, match=r"labels.parquet .* is damaged \("):
        list_images(path)


def test_a_histogram_that_fits_no_column_ends_no_process(tmp_path):
    """pyarrow 26 ends the process when it is asked for such a column's numbers."""
    rows = FeatureTable(("a", "b", "c"), {"geometry": np.ones((3, 4))}).write(tmp_path / "F.parquet")
    content = rows.read_bytes()
    optional, required = b"\x15\x0c\x25\x02\x18\x04file", b"\x15\x0c\x25\x00\x18\x04file"
    assert content.count(optional) == 1
    rows.write_bytes(content.replace(optional, required))
    with pytest.raises(ValueError, match=r"F.parquet is "):
        FeatureTable.read(rows)
