"""The directory of a zip, beside the one that Python's own reader finds."""

import io
import struct
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.data.zips import (
    Unseekable,
    old_names,
    packed,
    set_in_directory,
    some,
    twice,
    with_comments,
    with_zero_bytes,
)

from derender.data.zip_directory import MEMBER, members_of, read_directory

ARCHIVES = {
    "plain": packed(some()),
    "one": packed({"a.txt": b"a"}),
    "empty": packed({}),
    "streamed": packed(some(), into=Unseekable()),
    "behind a program": b"#!/bin/sh\nexit\n" * 9 + packed(some()),
    "comments": with_comments(),
    "other letters": packed({"ä/\u4e2d.txt": b"1", "plain.txt": b"2"}),
    "old names": old_names(),
    "zero bytes": with_zero_bytes(),
    "twice": twice(),
    "no name": packed({"a": b"1", "?b": b"2"}).replace(b"?b", b"\0b"),
    "marks in names": packed({"PK\1\2" * 9: b"PK\1\2", "PK\5\6": b"PK\5\6"}),
    "folders": packed({"a/": b"", "a/b.txt": b"1"}),
}


def ours(content: bytes) -> list[tuple[object, ...]]:
    names, members = members_of(read_directory(io.BytesIO(content)))
    assert members.dtype == MEMBER and len(names) == len(members)
    fields = ("offset", "packed", "size", "crc", "flags", "method")
    return [
        (name, *(row[field].item() for field in fields)) for name, row in zip(names, members, strict=True)
    ]


def pythons(content: bytes) -> list[tuple[object, ...]]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return [
            (m.filename, m.header_offset, m.compress_size, m.file_size, m.CRC, m.flag_bits, m.compress_type)
            for m in archive.infolist()
        ]


@pytest.mark.parametrize("content", ARCHIVES.values(), ids=ARCHIVES)
def test_the_members_are_those_that_python_finds(content):
    assert ours(content) == pythons(content)


def test_numbers_of_64_bits(monkeypatch):
    monkeypatch.setattr(zipfile, "ZIP64_LIMIT", 300)
    monkeypatch.setattr(zipfile, "ZIP_FILECOUNT_LIMIT", 3)
    content = packed(some(), zipfile.ZIP_STORED)
    assert b"PK\6\6" in content and content.count(b"\xff\xff\xff\xff") > 3
    assert ours(content) == pythons(content) and ours(b"before" + content) == pythons(b"before" + content)


def test_where_the_next_thing_begins():
    content = packed(some())
    directory = read_directory(io.BytesIO(content))
    _, members = members_of(directory)
    assert members["end"].tolist() == [*members["offset"][1:].tolist(), directory.start]
    assert directory.start == content.index(b"PK\1\2") and directory.shift == 0


def test_claims_beyond_any_file_are_cut(monkeypatch):
    monkeypatch.setattr(zipfile, "ZIP64_LIMIT", 300)
    content = packed({"a.txt": bytes(1000)}, zipfile.ZIP_STORED)
    size = struct.pack("<2Q", 1000, 1000)
    assert content.count(size) == 2
    at = content.rindex(size)
    claims = content[:at] + b"\xff" * 16 + content[at + 16 :]
    _, members = members_of(read_directory(io.BytesIO(claims)))
    assert members["size"] == members["packed"] == 1 << 62


PLAIN, END = ARCHIVES["plain"], struct.Struct("<4s4H2LH").size
DAMAGED = {
    "nothing": (b"", "no directory"),
    "no end": (PLAIN[:-END], "no directory"),
    "cut": (PLAIN[:-1], "no directory"),
    "only an end": (PLAIN[-END:], "not where the file says"),
    "too long a directory": (PLAIN[:-10] + b"\xff\xff\xff\x7f" + PLAIN[-6:], "not where the file says"),
    "too short a directory": (PLAIN[:-10] + struct.pack("<L", 90) + PLAIN[-6:], "damaged|cut short"),
    "no entry": (set_in_directory(PLAIN, "folder 1/3.txt", 2, b"\0\0"), "directory is damaged"),
    "a longer name": (set_in_directory(PLAIN, "folder 0/4.txt", 28, b"\xff\0"), "cut short"),
    "a later version": (set_in_directory(PLAIN, "folder 1/3.txt", 6, b"\x63"), r"version 9\.9"),
}


@pytest.mark.parametrize(("content", "message"), DAMAGED.values(), ids=DAMAGED)
def test_a_damaged_directory_is_refused(content, message):
    with pytest.raises(ValueError, match=message):
        ours(content)


def test_a_name_that_is_no_text_is_refused():
    flagged = set_in_directory(PLAIN, "folder 1/3.txt", 8, struct.pack("<H", 0x800))
    with pytest.raises(UnicodeDecodeError):
        ours(set_in_directory(flagged, "folder 1/3.txt", 46, b"\xff"))


def test_missing_numbers_and_several_parts_are_refused(monkeypatch):
    with_large = set_in_directory(with_comments(), "folder 1/3.txt", 24, b"\xff" * 4)
    assert ours(with_large)[3][3] == 0xFFFFFFFF  # as Python reads it: the number itself
    extra = with_large.rindex(
        struct.pack("<2H4s", 0x7777, 4, b"more"), 0, with_large.rindex(b"folder 0/4.txt")
    )
    with pytest.raises(ValueError, match="64 bits is missing"):
        ours(with_large[:extra] + b"\1\0" + with_large[extra + 2 :])
    monkeypatch.setattr(zipfile, "ZIP_FILECOUNT_LIMIT", 3)
    content = packed(some())
    at = content.rindex(b"PK\6\7")
    with pytest.raises(ValueError, match="several parts"):
        ours(content[: at + 16] + b"\2" + content[at + 17 :])
    with pytest.raises(ValueError, match="not where the file says"):
        ours(content[: at - 8] + b"\xff" * 8 + content[at:])


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    st.sampled_from(list(ARCHIVES.values())),
    st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), max_size=4),
)
def test_what_is_read_of_a_damaged_directory_is_what_python_reads(content, changes):
    damaged = bytearray(content)
    for place, value in changes:
        damaged[-1 - int(place * min(400, len(damaged) - 1))] = value
    try:
        found = ours(bytes(damaged))
    except ValueError:
        return
    try:
        expected = pythons(bytes(damaged))
    except (zipfile.BadZipFile, NotImplementedError):
        return  # extra fields that nobody needs
    assert found == expected


def test_very_many_members_are_few_arrays():
    content = packed({f"{row:05d}": b"" for row in range(3000)})
    names, members = members_of(read_directory(io.BytesIO(content)))
    assert names == [f"{row:05d}" for row in range(3000)] and set(np.diff(members["offset"])) == {37}
