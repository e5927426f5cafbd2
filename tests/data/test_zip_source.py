"""Members of a zip: those that Python's own reader finds, or one clear refusal; and any change is seen."""

import contextlib
import io
import lzma
import os
import struct
import warnings
import zipfile
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Lock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import derender
from derender.data import cache_folder, list_images, opening, zip_source
from derender.data.zip_source import Member, ZipSource, members_of, read_directory, read_member

PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
REFUSALS = (ValueError, OSError, EOFError, zlib.error, lzma.LZMAError)


class Unseekable(io.RawIOBase):
    """A pipe: what is written to it has its sizes behind its bytes."""

    def __init__(self) -> None:
        self.content = bytearray()

    def writable(self) -> bool:
        return True

    def write(self, data) -> int:
        self.content += data
        return len(data)


def packed(
    members: dict[str, bytes] | list[tuple[str, bytes]],
    how: int = zipfile.ZIP_DEFLATED,
    into: io.IOBase | None = None,
    comment: bytes = b"",
) -> bytes:
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


TWICE = packed([("a.txt", b"earlier"), ("b.txt", b"between"), ("a.txt", b"later")])
COMMENTED = packed(some(), comment=b"about PK\1\2 it PK\5\7")
ARCHIVES = {
    "plain": packed(some()),
    "one": packed({"a.txt": b"a"}),
    "empty": packed({}),
    "streamed": packed(some(), into=Unseekable()),
    "behind a program": b"#!/bin/sh\nexit\n" * 9 + packed(some()),
    "comments": COMMENTED,
    "other letters": packed({"ä/\u4e2d.txt": b"1", "plain.txt": b"2"}),
    "the first code page": packed({"AEOE.txt": b"one", "b.txt": b"2"}).replace(b"AEOE.", b"\x8e\x94\x99E."),
    "zero bytes": packed({"a.txt-.exe": b"one", "b.txt": b"2"}).replace(b"a.txt-.exe", b"a.txt\0.exe"),
    "twice": TWICE,
    "no name": packed({"a": b"1", "?b": b"2"}).replace(b"?b", b"\0b"),
    "marks in names": packed({"PK\1\2" * 9: b"PK\1\2", "PK\5\6": b"PK\5\6"}),
    "folders": packed({"a/": b"", "a/b.txt": b"1"}),
}


def members(content: bytes) -> list[tuple[str, Member]]:
    names, rows = members_of(read_directory(io.BytesIO(content)))
    return [(name, Member(*row)) for name, row in zip(names, rows.tolist(), strict=True)]


def ours(content: bytes) -> list[tuple[object, ...]]:
    return [(name, m.offset, m.packed, m.size, m.crc, m.flags, m.method) for name, m in members(content)]


def pythons(content: bytes) -> list[tuple[object, ...]]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return [
            (m.filename, m.header_offset, m.compress_size, m.file_size, m.CRC, m.flag_bits, m.compress_type)
            for m in archive.infolist()
        ]


def read(content: bytes, name: str) -> bytes:
    return read_member(io.BytesIO(content), Lock(), dict(members(content))[name], name)


@pytest.mark.parametrize("content", ARCHIVES.values(), ids=ARCHIVES)
def test_the_members_are_those_that_python_finds(content):
    assert ours(content) == pythons(content)


def test_numbers_of_64_bits(monkeypatch):
    monkeypatch.setattr(zipfile, "ZIP64_LIMIT", 300)
    monkeypatch.setattr(zipfile, "ZIP_FILECOUNT_LIMIT", 3)
    content = packed(some(), zipfile.ZIP_STORED)
    assert b"PK\6\6" in content and content.count(b"\xff\xff\xff\xff") > 3
    assert ours(content) == pythons(content) and ours(b"before" + content) == pythons(b"before" + content)
    assert {name: read(content, name) for name in some()} == some()
    size = struct.pack("<2Q", 1024, 1024)
    at = content.rindex(size)  # claims beyond any file are cut
    (*_, (_, claimed)) = members(content[:at] + b"\xff" * 16 + content[at + 16 :])
    assert claimed.size == claimed.packed == 1 << 62


def test_where_the_next_thing_begins():
    content = packed(some())
    found = [member for _, member in members(content)]
    start = content.index(b"PK\1\2")
    assert [member.end for member in found] == [*(member.offset for member in found[1:]), start]
    assert read_directory(io.BytesIO(content))[1:] == (start, 0)


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
    "a name that is no text": (
        set_in_directory(
            set_in_directory(PLAIN, "folder 1/3.txt", 8, struct.pack("<H", 0x800)),
            "folder 1/3.txt", 46, b"\xff",
        ),
        "utf-8",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("content", "message"), DAMAGED.values(), ids=DAMAGED)
def test_a_damaged_directory_is_refused(content, message):
    with pytest.raises(ValueError, match=message):
        ours(content)


def test_missing_numbers_and_several_parts_are_refused(monkeypatch):
    with_large = set_in_directory(COMMENTED, "folder 1/3.txt", 24, b"\xff" * 4)
    assert ours(with_large)[3][3] == 0xFFFFFFFF  # as Python reads it: the number itself
    mark = struct.pack("<2H4s", 0x7777, 4, b"more")
    extra = with_large.rindex(mark, 0, with_large.rindex(b"folder 0/4.txt"))
    with pytest.raises(ValueError, match="64 bits is missing"):
        ours(with_large[:extra] + b"\1\0" + with_large[extra + 2 :])
    monkeypatch.setattr(zipfile, "ZIP_FILECOUNT_LIMIT", 3)
    content = packed(some())
    at = content.rindex(b"PK\6\7")
    with pytest.raises(ValueError, match="several parts"):
        ours(content[: at + 16] + b"\2" + content[at + 17 :])
    with pytest.raises(ValueError, match="not where the file says"):
        ours(content[: at - 8] + b"\xff" * 8 + content[at:])


@pytest.mark.parametrize("how", PACKINGS)
@pytest.mark.parametrize("before", [b"", b"a program"])
def test_every_way_of_packing_is_read(how, before):
    content = before + packed(some(), how)
    assert {name: read(content, name) for name in some()} == some()


def test_sizes_behind_the_bytes_comments_and_one_name_twice():
    for content in (ARCHIVES["streamed"], COMMENTED):
        assert {name: read(content, name) for name in some()} == some()
    assert read(TWICE, "a.txt") == b"later"


def test_threads_share_the_stream():
    inside = {f"{row}.txt": bytes([row % 256]) * (row * 7) for row in range(300)}
    content = packed(inside)
    stream, lock, known = io.BytesIO(content), Lock(), dict(members(content))
    with ThreadPoolExecutor(8) as pool:
        found = pool.map(lambda name: read_member(stream, lock, known[name], name), inside)
    assert list(found) == list(inside.values())


NAME = "folder 1/3.txt"
AT = PLAIN.index(NAME.encode())
REFUSED = {
    "another name": (PLAIN[:AT] + b"F" + PLAIN[AT + 1 :], "another name"),
    "no header": (PLAIN[: AT - 30] + b"QK" + PLAIN[AT - 28 :], "not where"),
    "another place": (set_in_directory(PLAIN, NAME, 42, b"\1\0\0\0"), "not where"),
    "beyond the end": (set_in_directory(PLAIN, NAME, 42, b"\xff\xff\xff\x7f"), "not where"),
    "into the next": (set_in_directory(PLAIN, NAME, 20, b"\xff\xff"), "reaches into"),
    "packed strangely": (set_in_directory(PLAIN, NAME, 10, b"\x63"), r"not read \(number 99\)"),
    "a patch": (set_in_directory(PLAIN, NAME, 8, b"\x20"), "patch or encrypted"),
    "strongly encrypted": (set_in_directory(PLAIN, NAME, 8, b"\x40"), "patch or encrypted"),
    "another checksum": (set_in_directory(PLAIN, NAME, 16, b"\0\0"), "Bad CRC-32"),
    "more than it says": (set_in_directory(PLAIN, NAME, 24, b"\0\0"), "says 0 bytes, and there are more"),
    "less than it says": (set_in_directory(PLAIN, NAME, 24, b"\0\xff"), "65,280 bytes, and there are 768"),
}


@pytest.mark.parametrize(("content", "message"), REFUSED.values(), ids=REFUSED)
def test_what_does_not_agree_is_refused(content, message):
    with pytest.raises(ValueError, match=message):
        read(content, NAME)


def test_places_before_the_file_and_into_the_directory_are_refused():
    member = dict(members(PLAIN))[NAME]._replace(offset=-5)
    with pytest.raises(ValueError, match="not where"):
        read_member(io.BytesIO(PLAIN), Lock(), member, NAME)
    with pytest.raises(ValueError, match="reaches into"):
        read(set_in_directory(PLAIN, "folder 0/4.txt", 20, b"\xff\xff"), "folder 0/4.txt")


@pytest.mark.parametrize("how", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_no_more_is_unpacked_than_the_directory_says(how, monkeypatch):
    content = set_in_directory(packed({"a": bytes(5_000_000)}, how), "a", 24, struct.pack("<L", 100))
    unpacked, real = [], zip_source._unpacked
    monkeypatch.setattr(zip_source, "_unpacked", lambda *of: unpacked.append(real(*of)) or unpacked[-1])
    with pytest.raises(ValueError, match="says 100 bytes, and there are more"):
        read(content, "a")
    assert len(unpacked[0]) == 101


def test_lzma_gets_no_larger_a_dictionary_than_it_needs(monkeypatch):
    content = packed({"a.txt": bytes(range(256)) * 40}, zipfile.ZIP_LZMA)
    at = content.index(b"a.txt") + 5
    assert content[at + 2 : at + 4] == b"\5\0"
    sizes, real = [], lzma.LZMADecompressor

    def noted(form, filters):
        sizes.append(filters[0]["dict_size"])
        return real(form, filters=filters)

    monkeypatch.setattr(lzma, "LZMADecompressor", noted)
    claims = content[: at + 5] + b"\xff\xff\xff\xff" + content[at + 9 :]
    assert read(claims, "a.txt") == bytes(range(256)) * 40 and sizes == [10_240]
    with pytest.raises(ValueError, match="settings of LZMA"):
        read(content[: at + 2] + b"\6" + content[at + 3 :], "a.txt")


def pythons_bytes(content: bytes, offset: int) -> bytes | None:
    """What Python reads of the member there; None where it takes offence at something nobody needs."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            return archive.read(next(m for m in archive.infolist() if m.header_offset == offset))
    except (zipfile.BadZipFile, NotImplementedError, UnicodeDecodeError):
        return None


CHANGES = st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=4)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.sampled_from(list(ARCHIVES.values())), CHANGES)
def test_what_is_listed_of_a_damaged_directory_is_what_python_lists(content, changes):
    damaged = bytearray(content)
    for place, value in changes:
        damaged[-1 - int(place * min(400, len(damaged) - 1))] = value
    with contextlib.suppress(ValueError):
        found = ours(bytes(damaged))
        with contextlib.suppress(zipfile.BadZipFile, NotImplementedError):  # extra fields that nobody needs
            expected = pythons(bytes(damaged))
            assert found == expected


@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.sampled_from([packed(some(4), how) for how in PACKINGS]), CHANGES)
def test_what_is_read_of_a_damaged_archive_is_what_python_reads(content, changes):
    damaged = bytearray(content)
    for place, value in changes:
        damaged[int(place * (len(damaged) - 1))] = value
    with contextlib.suppress(ValueError):
        for name, member in members(bytes(damaged)):
            try:
                found = read_member(io.BytesIO(damaged), Lock(), member, name.replace("\\", "/"))
            except REFUSALS:
                continue
            assert (len(found), zlib.crc32(found)) == (member.size, member.crc)
            assert pythons_bytes(bytes(damaged), member.offset) in (found, None)


@pytest.fixture
def parsed(monkeypatch, tmp_path) -> list[int]:
    """Zips of 30 members are very large, in a cache of our own; the directories that were parsed."""
    monkeypatch.setattr("derender.data.listing.REMEMBERED_FROM", 30)
    monkeypatch.setenv("DERENDER_CACHE", str(tmp_path / "cache"))
    counted, real = [], zip_source.members_of
    monkeypatch.setattr(zip_source, "members_of", lambda directory: counted.append(1) or real(directory))
    return counted


@pytest.fixture
def archive(tree, parsed) -> Path:
    names = [f"{kind}/ä{row:02d}.png" for kind in ("cat", "dog") for row in range(20)]
    return tree([*names, "notes.csv", "../out.png", "secret.txt", "a\\b.txt"], zipped=True)


def known(path: Path, **options: str) -> tuple[object, ...]:
    """Everything there is to know of a zip, its members' bytes included."""
    with list_images(path, **options) as found:
        files = found.files
        stamps = files.stamps(files.files).tolist()
        assert files.stamps(files.images).tolist() == [stamps[files.row_of(file)] for file in files.images]
        contents = [files.read(file) for file in files.files]
        return found.layout, files.files, files.skipped, stamps, contents, found.identity()


def test_what_is_remembered_is_what_the_archive_holds(archive, parsed):
    archive.write_bytes(set_in_directory(archive.read_bytes(), "secret.txt", 8, b"\1"))
    first = known(archive)
    assert len(parsed) == 1 and len(list(cache_folder().glob("*.listing"))) == 1
    assert known(archive) == first and len(parsed) == 1
    assert first[0] == "classes" and len(first[1]) == 42 and "a/b.txt" in first[1]
    assert [row.file for row in first[2]] == ["../out.png", "secret.txt"]


def test_the_layout_is_recognised_once(archive, parsed, monkeypatch):
    asked, real = [], opening.recognise
    monkeypatch.setattr(opening, "recognise", lambda source: asked.append(1) or real(source))
    assert known(archive, dataset="folder")[0] == "folder" and not asked
    assert known(archive)[0] == known(archive)[0] == "classes"
    assert known(archive, dataset="folder")[0] == "folder"
    assert len(asked) == 1 and len(parsed) == 1


def contents_of(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def write_over_one(path: Path) -> None:
    """The same size, name and place, and the same time of change."""
    before, contents = path.stat(), contents_of(path)
    contents["notes.csv"] = contents["notes.csv"][::-1]
    path.write_bytes(packed(contents, zipfile.ZIP_STORED))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    after = path.stat()
    assert (after.st_size, after.st_mtime_ns) == (before.st_size, before.st_mtime_ns)


def rewrite(path: Path, content: bytes) -> None:
    path.write_bytes(content)


OLD, NEW = "dog/ä07.png".encode(), "dog/ä7x.png".encode()
CHANGED = {
    "add": lambda path: rewrite(path, packed(contents_of(path) | {"cat/new.png": b"x"})),
    "remove": lambda path: rewrite(path, packed(dict(list(contents_of(path).items())[1:]))),
    "rename": lambda path: rewrite(path, path.read_bytes().replace(OLD, NEW)),
    "write over one": write_over_one,
    "something before": lambda path: rewrite(path, b"a program" + path.read_bytes()),
}


@pytest.mark.parametrize("change", CHANGED)
def test_a_change_is_seen(archive, parsed, change):
    before = known(archive)
    CHANGED[change](archive)
    after = known(archive)
    assert len(parsed) == 2 and (after != before) == (change != "something before")
    for listing in cache_folder().glob("*.listing"):
        listing.unlink()
    assert known(archive) == after


@pytest.mark.parametrize("damage", ["empty", "junk", "cut", "one bit"])
def test_a_damaged_listing_is_made_again(archive, parsed, damage):
    first = known(archive)
    (listing,) = cache_folder().glob("*.listing")
    whole = listing.read_bytes()
    content = bytearray(whole)
    content[len(content) // 2] ^= 1
    listing.write_bytes(
        {"empty": b"", "junk": b"junk", "cut": whole[:-100], "one bit": bytes(content)}[damage]
    )
    assert known(archive) == first and len(parsed) == 2
    assert known(archive) == first and len(parsed) == 2


def test_another_archive_or_version_is_not_trusted(archive, parsed, monkeypatch):
    first = known(archive)
    monkeypatch.setattr(derender, "__version__", "0.0.0")
    assert known(archive) == first and len(parsed) == 2
    archive.unlink()
    archive.write_bytes(packed({f"{row}.png": b"x" for row in range(40)}))
    with ZipSource(archive) as other:
        assert len(other.files) == 40 and len(parsed) == 3


def test_small_zips_a_cache_that_cannot_be_written_and_missing_members(
    archive, parsed, monkeypatch, tmp_path
):
    monkeypatch.setattr("derender.data.listing.REMEMBERED_FROM", 100)
    known(archive)
    assert not cache_folder().exists()
    monkeypatch.setattr("derender.data.listing.REMEMBERED_FROM", 30)
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("DERENDER_CACHE", str(tmp_path / "file"))
    assert known(archive) == known(archive) and len(parsed) == 3
    with ZipSource(archive) as source:
        for name in ("", "cat/ä", "zzz"):
            with pytest.raises(ValueError, match=r"is not in .*set\.zip"):
                source.read(name)


def test_very_many_members_are_few_arrays():
    names, rows = members_of(read_directory(io.BytesIO(packed({f"{row:05d}": b"" for row in range(3000)}))))
    assert names == [f"{row:05d}" for row in range(3000)] and len(set(np.diff(rows[:, 0]))) == 1
