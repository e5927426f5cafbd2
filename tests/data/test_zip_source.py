"""Members of a zip: those that Python's own reader finds, or one clear refusal."""

import contextlib
import io
import struct
import tempfile
import tracemalloc
import warnings
import zipfile
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from derender.data import open_source
from derender.data.zip_source import members_of, read_directory

PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)


class Unseekable(io.RawIOBase):
    """A pipe: what is written to it has its sizes behind its bytes."""

    def __init__(self) -> None:
        self.content = bytearray()

    def writable(self) -> bool:
        return True

    def write(self, data) -> int:
        self.content += data
        return len(data)


def packed(members, how: int = zipfile.ZIP_DEFLATED, into: io.IOBase | None = None, comment: bytes = b""):
    """A zip of these members, with comments on it and on each of them if there is one."""
    buffer = into or io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(buffer, "w", how) as archive:
        warnings.simplefilter("ignore", UserWarning)  # names that are there twice
        for name, content in members.items() if isinstance(members, dict) else members:
            member = zipfile.ZipInfo(name)
            if comment:
                member.comment, member.extra = comment, struct.pack("<2H4s", 0x7777, 4, b"more")
            archive.writestr(member, content, compress_type=how)
        archive.comment = comment
    return bytes(buffer.content) if isinstance(buffer, Unseekable) else buffer.getvalue()


def some(count: int = 5) -> dict[str, bytes]:
    """Members of several lengths, the first of them empty."""
    return {f"folder {row % 2}/{row}.txt": bytes(range(256)) * row for row in range(count)}


def set_in_directory(content: bytes, name: str, at: int, value: bytes) -> bytes:
    """The archive with other bytes at this place of a member's entry in the directory."""
    changed = bytearray(content)
    begin = content.rfind(b"PK\1\2", 0, content.rfind(name.encode()))
    changed[begin + at : begin + at + len(value)] = value
    return bytes(changed)


COMMENTED = packed(some(), comment=b"about PK\1\2 it PK\5\7")
PLAIN, NAME = packed(some()), "folder 1/3.txt"
ARCHIVES = {
    "plain": PLAIN,
    "empty": packed({}),
    "streamed": packed(some(), into=Unseekable()),
    "behind a program": b"#!/bin/sh\nexit\n" * 9 + PLAIN,
    "comments": COMMENTED,
    "other letters": packed({"ä/\u4e2d.txt": b"1", "plain.txt": b"2"}),
    "the first code page": packed({"AEOE.txt": b"one", "b.txt": b"2"}).replace(b"AEOE.", b"\x8e\x94\x99E."),
    "zero bytes": packed({"a.txt-.exe": b"one", "b.txt": b"2"}).replace(b"a.txt-.exe", b"a.txt\0.exe"),
    "twice": packed([("a.txt", b"earlier"), ("b.txt", b"between"), ("a.txt", b"later")]),
    "marks in names": packed({"PK\1\2" * 9: b"PK\1\2", "PK\5\6": b"PK\5\6"}),
    "folders": packed({"a/": b"", "a/b.txt": b"1"}),
}


def ours(content: bytes) -> list[tuple[object, ...]]:
    names, rows = members_of(*read_directory(io.BytesIO(content)))
    return [(name, *row[:1], *row[2:]) for name, row in zip(names, rows.tolist(), strict=True)]


def pythons(content: bytes) -> list[tuple[object, ...]]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return [
            (m.filename, m.header_offset, m.compress_size, m.file_size, m.CRC, m.flag_bits, m.compress_type)
            for m in archive.infolist()
        ]


@pytest.fixture
def contents(tmp_path):
    """``contents(zip)`` reads every member of an archive's bytes."""

    def read(content: bytes) -> dict[str, bytes]:
        (tmp_path / "a.zip").write_bytes(content)
        with open_source(tmp_path / "a.zip") as source:
            return {file: source.read(file) for file in source.files}

    return read


@pytest.mark.parametrize("content", ARCHIVES.values(), ids=ARCHIVES)
def test_the_members_are_those_that_python_finds(content):
    assert ours(content) == pythons(content)


def test_numbers_of_64_bits(monkeypatch, contents):
    monkeypatch.setattr(zipfile, "ZIP64_LIMIT", 300)
    monkeypatch.setattr(zipfile, "ZIP_FILECOUNT_LIMIT", 3)
    content = packed(some(), zipfile.ZIP_STORED)
    assert b"PK\6\6" in content and content.count(b"\xff\xff\xff\xff") > 3
    assert ours(content) == pythons(content) and ours(b"before" + content) == pythons(b"before" + content)
    assert contents(content) == some()
    size = struct.pack("<2Q", 1024, 1024)
    at = content.rindex(size)  # claims beyond any file are cut
    assert ours(content[:at] + b"\xff" * 16 + content[at + 16 :])[-1][2:4] == (1 << 62, 1 << 62)
    at = content.rindex(b"PK\6\7")
    with pytest.raises(ValueError, match="several parts"):
        ours(content[: at + 16] + b"\2" + content[at + 17 :])
    with pytest.raises(ValueError, match="not where the file says"):
        ours(content[: at - 8] + b"\xff" * 8 + content[at:])


END = struct.Struct("<4s4H2LH").size
NO_TEXT = set_in_directory(set_in_directory(PLAIN, NAME, 8, struct.pack("<H", 0x800)), NAME, 46, b"\xff")
NO_NUMBER = set_in_directory(COMMENTED, NAME, 24, b"\xff" * 4)
EXTRA = NO_NUMBER.rindex(struct.pack("<2H4s", 0x7777, 4, b"more"), 0, NO_NUMBER.rindex(b"folder 0/4.txt"))
DAMAGED = {
    "nothing": (b"", "no directory"),
    "no end": (PLAIN[:-END], "no directory"),
    "cut": (PLAIN[:-1], "no directory"),
    "only an end": (PLAIN[-END:], "not where the file says"),
    "too long a directory": (PLAIN[:-10] + b"\xff\xff\xff\x7f" + PLAIN[-6:], "not where the file says"),
    "too short a directory": (PLAIN[:-10] + struct.pack("<L", 90) + PLAIN[-6:], "damaged|cut short"),
    "no entry": (set_in_directory(PLAIN, NAME, 2, b"\0\0"), "directory is damaged"),
    "a longer name": (set_in_directory(PLAIN, "folder 0/4.txt", 28, b"\xff\0"), "cut short"),
    "a later version": (set_in_directory(PLAIN, NAME, 6, b"\x63"), r"version 9\.9"),
    "a name that is no text": (NO_TEXT, "utf-8"),
    "a missing number": (NO_NUMBER[:EXTRA] + b"\1\0" + NO_NUMBER[EXTRA + 2 :], "64 bits is missing"),
}


@pytest.mark.parametrize(("content", "message"), DAMAGED.values(), ids=DAMAGED)
def test_a_damaged_directory_is_refused(content, message):
    with pytest.raises(ValueError, match=message):
        ours(content)


@pytest.mark.parametrize("how", PACKINGS)
@pytest.mark.parametrize("before", [b"", b"a program"])
def test_every_way_of_packing_is_read(how, before, contents):
    assert contents(before + packed(some(), how)) == some()


def test_sizes_behind_the_bytes_comments_and_one_name_twice(contents):
    assert contents(ARCHIVES["streamed"]) == contents(COMMENTED) == some()
    assert contents(ARCHIVES["twice"]) == {"a.txt": b"later", "b.txt": b"between"}


def test_threads_share_the_stream(tmp_path):
    inside = {f"{row}.txt": bytes([row % 256]) * (row * 7) for row in range(300)}
    (tmp_path / "a.zip").write_bytes(packed(inside))
    with open_source(tmp_path / "a.zip") as source, ThreadPoolExecutor(8) as pool:
        assert list(pool.map(source.read, inside)) == list(inside.values())


AT = PLAIN.index(NAME.encode())
REFUSED = {
    "another name": (PLAIN[:AT] + b"F" + PLAIN[AT + 1 :], "File name in directory"),
    "no header": (PLAIN[: AT - 30] + b"QK" + PLAIN[AT - 28 :], "Bad magic number"),
    "another place": (set_in_directory(PLAIN, NAME, 42, b"\1\0\0\0"), "Bad magic number|reaches into"),
    "beyond the end": (set_in_directory(PLAIN, NAME, 42, b"\xff\xff\xff\x7f"), "reaches into|Truncated"),
    "into the next": (set_in_directory(PLAIN, NAME, 20, b"\xff\xff"), "reaches into"),
    "packed strangely": (set_in_directory(PLAIN, NAME, 10, b"\x63"), "compression"),
    "a patch": (set_in_directory(PLAIN, NAME, 8, b"\x20"), "patched"),
    "strongly encrypted": (set_in_directory(PLAIN, NAME, 8, b"\x40"), "strong encryption"),
    "another checksum": (set_in_directory(PLAIN, NAME, 16, b"\0\0"), "Bad size or CRC-32"),
    "more than it says": (set_in_directory(PLAIN, NAME, 24, b"\1\0"), "Bad size or CRC-32"),
    "less than it says": (set_in_directory(PLAIN, NAME, 24, b"\0\xff"), "Bad size or CRC-32"),
}


@pytest.mark.parametrize(("content", "message"), REFUSED.values(), ids=REFUSED)
def test_what_does_not_agree_is_refused(content, message, contents):
    with pytest.raises(ValueError, match=f"cannot be unpacked: .*({message})"):
        contents(content)


@pytest.mark.parametrize("how", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_no_more_is_unpacked_than_the_directory_says(how, contents):
    content = set_in_directory(packed({"a": bytes(20_000_000)}, how), "a", 24, struct.pack("<L", 100))
    tracemalloc.start()
    with pytest.raises(ValueError, match="Bad size or CRC-32"):
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
        known = {name: (size, crc) for name, _, _, size, crc, _, _ in ours(bytes(damaged))}
        with open_source(Path(folder, "a.zip")) as source:
            for file in source.files:
                with contextlib.suppress(ValueError):
                    found = source.read(file)
                    assert (len(found), zlib.crc32(found)) == known[file]
