"""The members of a zip archive, read in place.

Python's ``zipfile`` makes an object of every member (20 seconds for a million) and unpacks whatever a member
holds. Here the directory becomes a table of numbers, and nothing in an archive is trusted: a directory that
cannot be refuses the archive; a member must lie where the directory says, bear the same name, end before the
next thing in the file begins (members within each other are how small archives unpack to endless ones) and
unpack to the size and CRC-32 that the directory says; no more than that is ever unpacked.

Members with absolute names or ``..`` in them and encrypted ones are passed over and listed. The remembered
listing of a very large archive holds while its directory is, byte for byte, the one it was made from.

Written from PKWARE's description of the format (APPNOTE.TXT 6.3.10, sections 4.3.7, 4.3.12 to 4.3.16, 4.4.4,
4.4.5, 4.5.3 and 5.8.8). Leaves out archives in several parts and encrypted directories.
"""

import bz2
import hashlib
import io
import lzma
import os
import struct
import zlib
from array import array
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from threading import Lock
from typing import NamedTuple

import numpy as np
from jaxtyping import Int64

from derender.data.listing import ListedSource, Listing
from derender.data.names import is_hidden
from derender.data.source import FILE_LIMIT_BYTES

_END = struct.Struct("<4s4H2LH")
_END_64 = struct.Struct("<4sQ2H2L4Q")
_LOCATOR_64 = struct.Struct("<4sLQL")
_ENTRY = struct.Struct("<4s2xBx2H4x3L3H8xL")
_HEADER = struct.Struct("<4s2xH18x2H")
_LONGEST_COMMENT = 65_535
_NEWEST_VERSION = 63  # of the format, times ten: what is packed for later ones may mean something else
_IN_EXTRA = 0xFFFF_FFFF  # a number of 64 bits stands in the extra field
_LARGEST = 1 << 62  # claims beyond are cut to this, so that sums of two stay whole numbers of 64 bits
_ENCRYPTED, _PATCHED, _STRONGLY_ENCRYPTED, _UTF8_NAME = 1, 0x20, 0x40, 0x800
_STORED, _DEFLATED, _BZIP2, _LZMA = 0, 8, 12, 14
_SMALLEST_DICTIONARY = 4096

# What unpacking raises on damaged members (found by feeding it such).
_UNPACKING_ERRORS = (OSError, ValueError, EOFError, zlib.error, lzma.LZMAError)


class Directory(NamedTuple):
    """The directory as it stands in the file: its bytes, where they begin, and how far everything lies behind
    where it says (as in archives with a program before them)."""

    content: bytes
    start: int
    shift: int


class Member(NamedTuple):
    """A row of the table: where a member's header and the next thing in the file begin, its bytes packed and
    unpacked, its CRC-32, and the format's flags and number of the way of packing."""

    offset: int
    end: int
    packed: int
    size: int
    crc: int
    flags: int
    method: int


class ZipSource(ListedSource):
    """The members of a zip; ``numbers`` are rows of ``Member``."""

    def __init__(self, path: Path):
        self._lock = Lock()
        self._stream = path.open("rb")
        try:
            self._directory = read_directory(self._stream)
            digest = hashlib.blake2b(self._directory.content, digest_size=32)
            digest.update(repr(self._directory[1:]).encode())
            self._digest = digest.hexdigest()
            super().__init__(path)
        except (OSError, ValueError) as problem:
            self._stream.close()
            raise ValueError(
                f"{path} is damaged or not a whole zip file ({problem}); download or copy it again"
            ) from problem
        del self._directory

    def read(self, file: str) -> bytes:
        member = Member(*self.numbers[self.row_of(file)].tolist())
        if member.size > FILE_LIMIT_BYTES:
            limit = f"more than {FILE_LIMIT_BYTES >> 20:,} MiB"
            raise ValueError(f"unpacks to {member.size >> 20:,} MiB, {limit}")
        try:
            return read_member(self._stream, self._lock, member, file)
        except _UNPACKING_ERRORS as problem:
            raise ValueError(f"cannot be unpacked: {problem}") from problem

    def stamps(self, files: Sequence[str]) -> Int64[np.ndarray, "n 2"]:
        rows = self.numbers[self.rows_of(files)]
        return rows[:, [Member._fields.index("size"), Member._fields.index("crc")]]

    def close(self) -> None:
        self._stream.close()

    def _holds(self, known: Listing) -> bool:
        return known.proof == {"directory": self._digest} and known.numbers.shape[1] == len(Member._fields)

    def _listed(self) -> Listing:
        """The members that are neither hidden, unsafe nor encrypted; of two with one name the later one."""
        names, members = members_of(self._directory)
        encrypted = (members[:, Member._fields.index("flags")] & _ENCRYPTED).astype(bool).tolist()
        rows: dict[str, int] = {}
        faults: list[tuple[str, str]] = []
        for row, (name, locked) in enumerate(zip(names, encrypted, strict=True)):
            file = name.replace("\\", "/")
            doubtful = not file or file.startswith((".", "/")) or "/." in file or ":" in file
            if not (doubtful or locked or "__MACOSX" in file):  # most are plain, of a million
                if not file.endswith("/"):
                    rows[file] = row
                continue
            parts = file.split("/")
            hidden = any(is_hidden(part) for part in parts if part not in (".", ".."))
            if not file or name.endswith("/") or hidden:
                continue
            if file.startswith("/") or ".." in parts or ":" in parts[0]:
                faults.append((file, "unsafe name in the zip (absolute or with ..)"))
            elif locked:
                faults.append((file, "encrypted in the zip"))
            else:
                rows[file] = row
        files = sorted(rows)
        numbers = members[[rows[file] for file in files]]
        return Listing(tuple(files), numbers, tuple(sorted(faults)), {"directory": self._digest})


def is_zip(path: Path) -> bool:
    """Whether the file ends in a zip's directory."""
    try:
        with path.open("rb") as stream:
            read_directory(stream)
    except (OSError, ValueError):
        return False
    return True


def read_directory(stream: io.BufferedIOBase) -> Directory:
    """Find and read the directory; ValueError where there is none or it is cut short."""
    length = stream.seek(0, os.SEEK_END)
    before = max(0, length - _END.size - _LONGEST_COMMENT - _END_64.size - _LOCATOR_64.size)
    stream.seek(before)
    tail = stream.read()
    at = len(tail) - _END.size
    if at < 0 or not (tail.startswith(b"PK\5\6", at) and tail.endswith(b"\0\0")):
        at = tail.rfind(b"PK\5\6", max(0, at - _LONGEST_COMMENT))
    if at < 0 or at + _END.size > len(tail):
        raise ValueError("no directory is found at its end")
    *_, size, offset, _ = _END.unpack_from(tail, at)
    start = before + at - size
    locator = at - _LOCATOR_64.size
    if locator >= _END_64.size and tail.startswith(b"PK\6\7", locator):
        _, disk, _, disks = _LOCATOR_64.unpack_from(tail, locator)
        if disk != 0 or disks > 1:
            raise ValueError("it is one of several parts")
        signature, *_, size_64, offset_64 = _END_64.unpack_from(tail, locator - _END_64.size)
        if signature == b"PK\6\6":
            size, offset = size_64, offset_64
            start = before + locator - _END_64.size - size
    if start < 0 or offset > _LARGEST:
        raise ValueError("its directory is not where the file says")
    stream.seek(start)
    content = stream.read(size)
    if len(content) != size:
        raise ValueError("its directory is cut short")
    return Directory(content, start, start - offset)


def members_of(directory: Directory) -> tuple[list[str], Int64[np.ndarray, "n 7"]]:
    """The name of every member, cut at its first zero byte, and its row; ValueError if that is damaged."""
    content, at, last = directory.content, 0, len(directory.content) - _ENTRY.size
    written: list[bytes] = []
    numbers = array("q")
    unpack, shift = _ENTRY.unpack_from, directory.shift
    while at <= last:
        entry = unpack(content, at)
        signature, needed, flags, method, crc, packed, size, name, extra, comment, offset = entry
        if signature != b"PK\1\2":
            raise ValueError("its directory is damaged")
        if needed > _NEWEST_VERSION:
            raise ValueError(f"it needs version {needed / 10:.1f} of the format")
        begin = at + _ENTRY.size
        at = begin + name + extra + comment
        written.append(content[begin : begin + name])
        if size == _IN_EXTRA or packed == _IN_EXTRA or offset == _IN_EXTRA:
            numbers_64 = content[begin + name : begin + name + extra]
            size, packed, offset = _from_extra((size, packed, offset), numbers_64)
        numbers.extend((offset + shift, 0, packed, size, crc, flags, method))
    if at != len(content):
        raise ValueError("its directory is cut short")
    members = np.frombuffer(numbers, np.int64).reshape(-1, len(Member._fields))
    places = np.unique(np.append(members[:, 0], directory.start))
    following = np.searchsorted(places, members[:, 0], "right")
    members[:, 1] = places[np.minimum(following, len(places) - 1)]
    joined = b"\0".join(written)
    if written and joined.isascii() and joined.count(b"\0") == len(written) - 1:
        return joined.decode("ascii").split("\0"), members
    flags = members[:, Member._fields.index("flags")].tolist()
    return [_decoded(name, flag) for name, flag in zip(written, flags, strict=True)], members


def _from_extra(values: tuple[int, ...], extra: bytes) -> tuple[int, ...]:
    """The values with the 64-bit numbers of the extra field, where only those stand that did not fit."""
    found, at = list(values), 0
    while at + 4 <= len(extra):
        kind, length = struct.unpack_from("<2H", extra, at)
        at += 4
        if kind == 1 and at + length <= len(extra):
            large = [place for place, value in enumerate(found) if value == _IN_EXTRA]
            if length < 8 * len(large):
                raise ValueError("a number of 64 bits is missing in its directory")
            for number, place in enumerate(large):
                claimed = int.from_bytes(extra[at + 8 * number : at + 8 * number + 8], "little")
                found[place] = min(claimed, _LARGEST)
        at += length
    return tuple(found)


def _decoded(name: bytes, flags: int) -> str:
    """A name as text: UTF-8 where a flag says so, else the code page that the format began with.

    It ends at the first zero byte, behind which other things could hide.
    """
    return name.decode("utf-8" if flags & _UTF8_NAME else "cp437").partition("\0")[0]


def read_member(
    stream: io.BufferedIOBase, lock: AbstractContextManager[object], member: Member, file: str
) -> bytes:
    """The content of a member.

    Args:
        stream: the archive.
        lock: held while the stream is moved and read, so that threads may share it.
        member: where it is, and what the directory says of it.
        file: its name, with forward slashes.

    Raises:
        ValueError: it is damaged, or packed in a way that is not read. Unpacking raises OSError, EOFError,
            zlib.error and lzma.LZMAError, too.
    """
    if member.flags & (_PATCHED | _STRONGLY_ENCRYPTED):
        raise ValueError("it is a patch or encrypted")
    with lock:
        stream.seek(max(0, member.offset))
        header = stream.read(_HEADER.size)
        if len(header) < _HEADER.size or not header.startswith(b"PK\3\4") or member.offset < 0:
            raise ValueError("it is not where the zip's directory says")
        _, flags, name_length, extra_length = _HEADER.unpack(header)
        before = name_length + extra_length
        if member.offset + _HEADER.size + before + member.packed > member.end:
            raise ValueError("it reaches into what comes after it")
        rest = stream.read(before + member.packed)
    if len(rest) < before + member.packed:
        raise ValueError("it is cut short")
    if _decoded(rest[:name_length], flags).replace("\\", "/") != file:
        raise ValueError("the zip's directory has another name for it")
    content = _unpacked(member, rest[before:])
    if len(content) != member.size:
        more = "more" if len(content) > member.size else f"{len(content):,}"
        raise ValueError(f"the zip's directory says {member.size:,} bytes, and there are {more}")
    if zlib.crc32(content) != member.crc:
        raise ValueError("Bad CRC-32")
    return content


def _unpacked(member: Member, packed: bytes) -> bytes:
    """At most one byte more than the directory says, which tells that there would be more."""
    most = member.size + 1
    if member.method == _STORED:
        return packed
    if member.method == _DEFLATED:
        return zlib.decompressobj(-zlib.MAX_WBITS).decompress(packed, most)
    if member.method == _BZIP2:
        return bz2.BZ2Decompressor().decompress(packed, most)
    if member.method != _LZMA:
        raise ValueError(f"packed in a way that is not read (number {member.method})")
    # the settings stand in the first nine bytes; a dictionary is never larger than what is unpacked
    if len(packed) < 9 or packed[2:4] != b"\5\0":
        raise ValueError("the settings of LZMA are damaged")
    code, dictionary = packed[4], int.from_bytes(packed[5:9], "little")
    settings = {"id": lzma.FILTER_LZMA1, "lc": code % 9, "lp": code // 9 % 5, "pb": code // 45}
    settings["dict_size"] = max(_SMALLEST_DICTIONARY, min(dictionary, member.size))
    return lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=[settings]).decompress(packed[9:], most)
