"""Members read at their places: the bytes Python's reader gives, or one clear refusal."""

import contextlib
import io
import lzma
import struct
import zipfile
import zlib
from concurrent.futures import ThreadPoolExecutor
from threading import Lock

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.data.zips import PACKINGS, Unseekable, packed, set_in_directory, some, twice, with_comments

from derender.data import zip_member
from derender.data.zip_directory import members_of, read_directory
from derender.data.zip_member import Member, read_member

REFUSALS = (ValueError, OSError, EOFError, zlib.error, lzma.LZMAError)


def members(content: bytes) -> dict[str, Member]:
    names, rows = members_of(read_directory(io.BytesIO(content)))
    return {name: Member(*row.item()) for name, row in zip(names, rows, strict=True)}


def read(content: bytes, name: str) -> bytes:
    return read_member(io.BytesIO(content), Lock(), members(content)[name], name)


@pytest.mark.parametrize("how", PACKINGS)
@pytest.mark.parametrize("before", [b"", b"a program"])
def test_every_way_of_packing(how, before):
    content = before + packed(some(), how)
    assert {name: read(content, name) for name in some()} == some()


def test_sizes_behind_the_bytes_comments_and_numbers_of_64_bits(monkeypatch):
    streamed = packed(some(), into=Unseekable())
    monkeypatch.setattr(zipfile, "ZIP64_LIMIT", 300)
    for content in (streamed, with_comments(), packed(some())):
        assert {name: read(content, name) for name in some()} == some()


def test_of_one_name_twice_the_later_one():
    assert read(twice(), "a.txt") == b"later"


def test_threads_share_the_stream():
    inside = {f"{row}.txt": bytes([row % 256]) * (row * 7) for row in range(300)}
    content = packed(inside)
    stream, lock, known = io.BytesIO(content), Lock(), members(content)
    with ThreadPoolExecutor(8) as pool:
        found = pool.map(lambda name: read_member(stream, lock, known[name], name), inside)
    assert list(found) == list(inside.values())


CONTENT = packed(some())
NAME = "folder 1/3.txt"
AT = CONTENT.index(NAME.encode())
REFUSED = {
    "another name": (CONTENT[:AT] + b"F" + CONTENT[AT + 1 :], "another name"),
    "no header": (CONTENT[: AT - 30] + b"QK" + CONTENT[AT - 28 :], "not where"),
    "another place": (set_in_directory(CONTENT, NAME, 42, b"\1\0\0\0"), "not where"),
    "beyond the end": (set_in_directory(CONTENT, NAME, 42, b"\xff\xff\xff\x7f"), "not where"),
    "into the next": (set_in_directory(CONTENT, NAME, 20, b"\xff\xff"), "reaches into"),
    "packed strangely": (set_in_directory(CONTENT, NAME, 10, b"\x63"), r"not read \(number 99\)"),
    "a patch": (set_in_directory(CONTENT, NAME, 8, b"\x20"), "patch or encrypted"),
    "strongly encrypted": (set_in_directory(CONTENT, NAME, 8, b"\x40"), "patch or encrypted"),
    "another checksum": (set_in_directory(CONTENT, NAME, 16, b"\0\0"), "Bad CRC-32"),
    "more than it says": (set_in_directory(CONTENT, NAME, 24, b"\0\0"), "says 0 bytes, and there are more"),
    "less than it says": (
        set_in_directory(CONTENT, NAME, 24, b"\0\xff"),
        "says 65,280 bytes, and there are 768",
    ),
}


@pytest.mark.parametrize(("content", "message"), REFUSED.values(), ids=REFUSED)
def test_what_does_not_agree_is_refused(content, message):
    with pytest.raises(ValueError, match=message):
        read(content, NAME)


def test_a_place_before_the_file_is_refused():
    member = members(CONTENT)[NAME]._replace(offset=-5)
    with pytest.raises(ValueError, match="not where"):
        read_member(io.BytesIO(CONTENT), Lock(), member, NAME)


def test_the_last_member_ends_before_the_directory():
    last = "folder 0/4.txt"
    assert read(CONTENT, last) == some()[last]
    with pytest.raises(ValueError, match="reaches into"):
        read(set_in_directory(CONTENT, last, 20, b"\xff\xff"), last)


@pytest.mark.parametrize("how", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_no_more_is_unpacked_than_the_directory_says(how, monkeypatch):
    content = set_in_directory(packed({"a": bytes(5_000_000)}, how), "a", 24, struct.pack("<L", 100))
    unpacked, real = [], zip_member._unpacked

    def noted(member: Member, packed: bytes) -> bytes:
        unpacked.append(real(member, packed))
        return unpacked[-1]

    monkeypatch.setattr(zip_member, "_unpacked", noted)
    with pytest.raises(ValueError, match="says 100 bytes, and there are more"):
        read(content, "a")
    assert len(unpacked[0]) == 101


def test_lzma_gets_no_larger_a_dictionary_than_it_needs(monkeypatch):
    content = packed({"a.txt": bytes(range(256)) * 40}, zipfile.ZIP_LZMA)
    at = content.index(b"a.txt") + 5
    assert content[at + 2 : at + 4] == b"\5\0"
    claims = content[: at + 5] + b"\xff\xff\xff\xff" + content[at + 9 :]
    asked, real = [], lzma.LZMADecompressor

    def noted(form, filters):
        asked.append(filters[0]["dict_size"])
        return real(form, filters=filters)

    monkeypatch.setattr(lzma, "LZMADecompressor", noted)
    assert read(claims, "a.txt") == bytes(range(256)) * 40
    assert asked == [10_240]
    with pytest.raises(ValueError, match="settings of LZMA"):
        read(content[: at + 2] + b"\6" + content[at + 3 :], "a.txt")


def pythons(content: bytes, offset: int) -> bytes | None:
    """What Python reads of the member there; None where it takes offence at something nobody needs."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            return archive.read(next(m for m in archive.infolist() if m.header_offset == offset))
    except (zipfile.BadZipFile, NotImplementedError, UnicodeDecodeError):
        return None


@settings(max_examples=200, deadline=None, derandomize=True)
@given(
    st.sampled_from([packed(some(4), how) for how in PACKINGS]),
    st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=4),
)
def test_what_is_read_of_a_damaged_archive_is_what_python_reads(content, changes):
    damaged = bytearray(content)
    for place, value in changes:
        damaged[int(place * (len(damaged) - 1))] = value
    with contextlib.suppress(ValueError):
        for name, member in members(bytes(damaged)).items():
            try:
                found = read_member(io.BytesIO(damaged), Lock(), member, name.replace("\\", "/"))
            except REFUSALS:
                continue
            assert (len(found), zlib.crc32(found)) == (member.size, member.crc)
            assert pythons(bytes(damaged), member.offset) in (found, None)
