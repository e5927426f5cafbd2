"""The directory at the end of a zip, as a column of names and a table of numbers instead of many objects.

Written from PKWARE's description of the format (APPNOTE.TXT 6.3.10, sections 4.3.12 to 4.3.16 and 4.5.3).
Nothing in it is trusted: what cannot be refuses the archive, what members claim is checked when they are read
(data/zip_member.py). Leaves out archives in several parts and encrypted directories.
"""

import io
import os
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

MEMBER = np.dtype(
    [
        ("offset", "<i8"),
        ("end", "<i8"),
        ("packed", "<i8"),
        ("size", "<i8"),
        ("crc", "<u4"),
        ("flags", "<u2"),
        ("method", "<u2"),
    ]
)
"""What is known of a member: where its header and the next thing in the file begin, its bytes packed and
unpacked, its CRC-32, and the format's flags and number of the way of packing."""

UTF8_NAME = 0x800

_END = struct.Struct("<4s4H2LH")
_END_64 = struct.Struct("<4sQ2H2L4Q")
_LOCATOR_64 = struct.Struct("<4sLQL")
_LONGEST_COMMENT = 65_535
_NEWEST_VERSION = 63  # of the format, times ten: what is packed for later ones may mean something else
_IN_EXTRA = 0xFFFF_FFFF  # a number of 64 bits stands in the extra field
_EXTRA_64 = 1
_MAY_BE_LARGE = ("size", "packed", "offset")  # in the order in which they stand there
_LARGEST = (
    1 << 62
)  # claims beyond are cut to this: more than any file has, and sums of two stay whole numbers

_ENTRY = np.dtype(
    [
        ("signature", "S4"),
        ("made_by", "<u2"),
        ("needed", "u1"),
        ("system", "u1"),
        ("flags", "<u2"),
        ("method", "<u2"),
        ("time", "<u2"),
        ("date", "<u2"),
        ("crc", "<u4"),
        ("packed", "<u4"),
        ("size", "<u4"),
        ("name", "<u2"),
        ("extra", "<u2"),
        ("comment", "<u2"),
        ("disk", "<u2"),
        ("internal", "<u2"),
        ("external", "<u4"),
        ("offset", "<u4"),
    ]
)
_LENGTHS = struct.Struct("<3H")
_LENGTHS_AT = 28


@dataclass(frozen=True)
class Directory:
    """The directory as it stands in the file.

    Attributes:
        content: its bytes.
        start: where in the file it begins.
        shift: how far everything lies behind where it says, as in archives with a program before them.
    """

    content: bytes
    start: int
    shift: int


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
    large = _large_end(tail[:at])
    if large is not None:
        size, offset = large
        start = before + at - _LOCATOR_64.size - _END_64.size - size
    if start < 0 or offset > _LARGEST:
        raise ValueError("its directory is not where the file says")
    stream.seek(start)
    content = stream.read(size)
    if len(content) != size:
        raise ValueError("its directory is cut short")
    return Directory(content, start, start - offset)


def is_zip(path: Path) -> bool:
    """Whether the file ends in a zip's directory."""
    try:
        with path.open("rb") as stream:
            read_directory(stream)
    except (OSError, ValueError):
        return False
    return True


def _large_end(before: bytes) -> tuple[int, int] | None:
    """Size and place of the directory from the 64-bit records before the last one, where there are any."""
    at = len(before) - _LOCATOR_64.size - _END_64.size
    if at < 0:
        return None
    signature, disk, _, disks = _LOCATOR_64.unpack_from(before, at + _END_64.size)
    if signature != b"PK\6\7":
        return None
    if disk != 0 or disks > 1:
        raise ValueError("it is one of several parts")
    signature, *_, size, offset = _END_64.unpack_from(before, at)
    return (size, offset) if signature == b"PK\6\6" else None


def members_of(directory: Directory) -> tuple[list[str], np.ndarray]:
    """The name of every member as it is written, cut at the first zero byte, and a row of ``MEMBER`` for it.

    Raises:
        ValueError: the directory is damaged.
    """
    content = directory.content
    starts = _starts(content)
    if not len(starts):
        return [], np.empty(0, MEMBER)
    anywhere = np.ndarray((len(content) - _ENTRY.itemsize + 1,), _ENTRY, content, strides=(1,))
    entries = anywhere[starts]
    if (entries["signature"] != b"PK\1\2").any():
        raise ValueError("its directory is damaged")
    if entries["needed"].max() > _NEWEST_VERSION:
        raise ValueError(f"it needs version {entries['needed'].max() / 10:.1f} of the format")
    members = np.empty(len(starts), MEMBER)
    for name in ("offset", "packed", "size", "crc", "flags", "method"):
        members[name] = entries[name]
    in_extra = np.logical_or.reduce([members[name] == _IN_EXTRA for name in _MAY_BE_LARGE])
    for row in np.flatnonzero(in_extra).tolist():
        begin = starts[row] + _ENTRY.itemsize + int(entries["name"][row])
        _read_extra(members[row : row + 1], content[begin : begin + int(entries["extra"][row])])
    members["offset"] += directory.shift
    places = np.unique(np.append(members["offset"], directory.start))
    following = np.searchsorted(places, members["offset"], "right")
    members["end"] = places[np.minimum(following, len(places) - 1)]
    return _names(content, starts + _ENTRY.itemsize, entries), members


def _starts(content: bytes) -> np.ndarray:
    """Where each entry begins: its three lengths lead to the next one."""
    starts: list[int] = []
    at, last = 0, len(content) - _ENTRY.itemsize
    unpack = _LENGTHS.unpack_from
    while at <= last:
        starts.append(at)
        name, extra, comment = unpack(content, at + _LENGTHS_AT)
        at += _ENTRY.itemsize + name + extra + comment
    if at != len(content):
        raise ValueError("its directory is cut short")
    return np.array(starts, np.int64)


def _read_extra(member: np.ndarray, extra: bytes) -> None:
    """Fill in the numbers of 64 bits: only those are there that did not fit."""
    at = 0
    while at + 4 <= len(extra):
        kind, length = struct.unpack_from("<2H", extra, at)
        at += 4
        if kind == _EXTRA_64 and at + length <= len(extra):
            for name in _MAY_BE_LARGE:
                if member[name][0] == _IN_EXTRA:
                    if length < 8:
                        raise ValueError("a number of 64 bits is missing in its directory")
                    member[name] = min(int.from_bytes(extra[at : at + 8], "little"), _LARGEST)
                    at, length = at + 8, length - 8
        at += length


def _names(content: bytes, begins: np.ndarray, entries: np.ndarray) -> list[str]:
    ends = begins + entries["name"]
    written = [content[begin:end] for begin, end in zip(begins.tolist(), ends.tolist(), strict=True)]
    joined = b"\0".join(written)
    if joined.isascii() and joined.count(b"\0") == len(written) - 1:
        return joined.decode("ascii").split("\0")
    return [decoded_name(name, flags) for name, flags in zip(written, entries["flags"].tolist(), strict=True)]


def decoded_name(name: bytes, flags: int) -> str:
    """A name as text: UTF-8 where a flag says so, else the code page that the format began with.

    It ends at the first zero byte, behind which other things could hide.
    """
    return name.decode("utf-8" if flags & UTF8_NAME else "cp437").partition("\0")[0]
