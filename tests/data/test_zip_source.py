"""Members of a zip: whole, or one clear refusal."""

import contextlib
import io
import struct
import tempfile
import tracemalloc
import warnings
import zipfile
import zlib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from derender.data import open_source

PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def packed(members, how: int = zipfile.ZIP_DEFLATED) -> bytes:
    buffer = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(buffer, "w", how) as archive:
        warnings.simplefilter("ignore", UserWarning)  # names that are there twice
        for name, content in members.items() if isinstance(members, dict) else members:
            archive.writestr(zipfile.ZipInfo(name), content, compress_type=how)
    return buffer.getvalue()


def some(count: int = 5) -> dict[str, bytes]:
    """Members of several lengths, the first of them empty."""
    return {f"folder {row % 2}/{row}.txt": bytes(range(256)) * row for row in range(count)}


def set_in_directory(content: bytes, name: str, at: int, value: bytes) -> bytes:
    """The archive with other bytes at this place of a member's entry in the directory."""
    changed = bytearray(content)
    begin = content.rfind(b"PK\1\2", 0, content.rfind(name.encode()))
    changed[begin + at : begin + at + len(value)] = value
    return bytes(changed)


PLAIN, NAME = packed(some()), "folder 1/3.txt"
AT = PLAIN.index(NAME.encode())


@pytest.fixture
def contents(tmp_path):
    """``contents(zip)`` reads every member of an archive's bytes."""

    def read(content: bytes) -> dict[str, bytes]:
        (tmp_path / "a.zip").write_bytes(content)
        with open_source(tmp_path / "a.zip") as source:
            return {file: source.read(file) for file in source.files}

    return read


@pytest.mark.parametrize("how", PACKINGS)
@pytest.mark.parametrize("before", [b"", b"a program"])
def test_every_way_of_packing_is_read(how, before, contents):
    assert contents(before + packed(some(), how)) == some()


@pytest.mark.parametrize("how", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA, None])
def test_members_packed_otherwise_are_passed_over_by_name(how, tmp_path):
    strange = set_in_directory(PLAIN, NAME, 10, b"\x63") if how is None else packed(some(), how)
    (tmp_path / "a.zip").write_bytes(strange)
    with open_source(tmp_path / "a.zip") as source:
        names = {row.file for row in source.skipped if "pack the zip by deflate" in row.reason}
        assert names == ({NAME} if how is None else set(some())) and not names & set(source.files)


def test_one_name_twice_and_separators_of_other_systems(contents):
    twice = packed([("a.txt", b"earlier"), ("b\\c.txt", b"between"), ("a.txt", b"later")])
    assert contents(twice) == {"a.txt": b"later", "b/c.txt": b"between"}


AS_TEXT = set_in_directory(PLAIN, NAME, 8, struct.pack("<H", 0x800))
DAMAGED, REFUSED = "damaged or not a whole zip", "cannot be unpacked: .*"
FAULTS = {
    "cut": (PLAIN[:-1], DAMAGED),
    "too long a directory": (PLAIN[:-10] + b"\xff\xff\xff\x7f" + PLAIN[-6:], DAMAGED),
    "no entry": (set_in_directory(PLAIN, NAME, 2, b"\0\0"), DAMAGED),
    "a later version": (set_in_directory(PLAIN, NAME, 6, b"\x63"), DAMAGED),
    "a name that is no text": (set_in_directory(AS_TEXT, NAME, 46, b"\xff"), DAMAGED),
    "another name": (PLAIN[:AT] + b"F" + PLAIN[AT + 1 :], REFUSED + "File name in directory"),
    "another place": (set_in_directory(PLAIN, NAME, 42, b"\1\0\0\0"), REFUSED + "(Bad magic|reaches into)"),
    "into the next": (set_in_directory(PLAIN, NAME, 20, b"\xff\xff"), REFUSED + "reaches into"),
    "another checksum": (set_in_directory(PLAIN, NAME, 16, b"\0\0"), REFUSED + "Bad CRC-32"),
    "more than it says": (set_in_directory(PLAIN, NAME, 24, b"\1\0"), REFUSED + "Bad CRC-32"),
    "less than it says": (
        set_in_directory(PLAIN, NAME, 24, b"\0\xff"),
        REFUSED + "(shorter than|Bad CRC-32)",
    ),
}


@pytest.mark.parametrize(("content", "message"), FAULTS.values(), ids=FAULTS)
def test_what_is_damaged_or_does_not_agree_is_refused(content, message, contents):
    with pytest.raises(ValueError, match=message):
        contents(content)


def test_no_more_is_unpacked_than_the_directory_says(contents):
    content = set_in_directory(packed({"a": bytes(20_000_000)}), "a", 24, struct.pack("<L", 100))
    tracemalloc.start()
    with pytest.raises(ValueError, match="CRC-32"):
        contents(content)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 1_000_000


CHANGES = st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=4)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(st.sampled_from([packed(some(4), how) for how in PACKINGS]), CHANGES)
def test_of_a_damaged_archive_is_read_what_its_directory_says_or_nothing(content, changes):
    damaged = bytearray(content)
    for place, value in changes:
        damaged[int(place * (len(damaged) - 1))] = value
    with tempfile.TemporaryDirectory() as folder, contextlib.suppress(ValueError):
        Path(folder, "a.zip").write_bytes(bytes(damaged))
        with open_source(Path(folder, "a.zip")) as source:
            sizes = source.stamps(source.files).tolist()
            for file, known in zip(source.files, sizes, strict=True):
                with contextlib.suppress(ValueError):
                    result = source.read(file)
                    assert [len(result), zlib.crc32(result)] == known
