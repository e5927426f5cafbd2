"""One member of a zip, read at its place.

Its own header must be where the directory says and bear the same name, it must end before the next thing in
the file begins (members that lie within each other are how small archives unpack to endless ones), and what
is unpacked must have the size and the CRC-32 that the directory says; no more than that is ever unpacked.
Written from PKWARE's description of the format (APPNOTE.TXT 6.3.10, sections 4.3.7, 4.4.4, 4.4.5 and 5.8.8).
"""

import bz2
import io
import lzma
import struct
import zlib
from contextlib import AbstractContextManager
from typing import NamedTuple

from derender.data.zip_directory import decoded_name

_HEADER = struct.Struct("<4s2xH18x2H")
_PATCHED, _STRONGLY_ENCRYPTED = 0x20, 0x40
_STORED, _DEFLATED, _BZIP2, _LZMA = 0, 8, 12, 14
_SMALLEST_DICTIONARY = 4096


class Member(NamedTuple):
    """A row of ``MEMBER`` (data/zip_directory.py)."""

    offset: int
    end: int
    packed: int
    size: int
    crc: int
    flags: int
    method: int


def read_member(
    stream: io.BufferedIOBase, lock: AbstractContextManager[object], member: Member, file: str
) -> bytes:
    """What is in a member.

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
    content = _unpacked(member, _packed(stream, lock, member, file))
    if len(content) != member.size:
        more = "more" if len(content) > member.size else f"{len(content):,}"
        raise ValueError(f"the zip's directory says {member.size:,} bytes, and there are {more}")
    if zlib.crc32(content) != member.crc:
        raise ValueError("Bad CRC-32")
    return content


def _packed(
    stream: io.BufferedIOBase, lock: AbstractContextManager[object], member: Member, file: str
) -> bytes:
    """The member's bytes as they are in the file, behind its header."""
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
    if decoded_name(rest[:name_length], flags).replace("\\", "/") != file:
        raise ValueError("the zip's directory has another name for it")
    return rest[before:]


def _unpacked(member: Member, packed: bytes) -> bytes:
    """At most one byte more than the directory says, which tells that there would be more."""
    most = member.size + 1
    if member.method == _STORED:
        return packed
    if member.method == _DEFLATED:
        return zlib.decompressobj(-zlib.MAX_WBITS).decompress(packed, most)
    if member.method == _BZIP2:
        return bz2.BZ2Decompressor().decompress(packed, most)
    if member.method == _LZMA:
        return _lzma_decompressor(packed, member.size).decompress(packed[9:], most)
    raise ValueError(f"packed in a way that is not read (number {member.method})")


def _lzma_decompressor(packed: bytes, size: int) -> lzma.LZMADecompressor:
    """The decoder whose settings stand in the first nine bytes: version, length 5, and five of settings.

    Its dictionary is as large as what is unpacked and no larger, whatever is claimed.
    """
    if len(packed) < 9 or packed[2:4] != b"\5\0":
        raise ValueError("the settings of LZMA are damaged")
    code, dictionary = packed[4], int.from_bytes(packed[5:9], "little")
    settings = {
        "id": lzma.FILTER_LZMA1,
        "lc": code % 9,
        "lp": code // 9 % 5,
        "pb": code // 45,
        "dict_size": max(_SMALLEST_DICTIONARY, min(dictionary, size)),
    }
    return lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=[settings])
