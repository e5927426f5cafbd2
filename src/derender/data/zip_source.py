"""The members of a zip archive, read in place.

Python's ``zipfile`` makes an object of every member, which takes 20 seconds for a million. Here the directory
becomes a table of numbers, and ``zipfile`` reads one member at a time and checks its name; no more is ever
unpacked than the directory says. Refused are a directory that cannot be, a member that reaches into what
comes after it (members within each other are how small archives unpack to endless ones), another CRC-32 than
in the directory, and a size beyond ``FILE_LIMIT_BYTES``.

Members with absolute names or ``..`` in them and encrypted ones are passed over and listed. A remembered
listing holds while the directory is, byte for byte, the one it was made from. Written from PKWARE's
APPNOTE.TXT 6.3.10; leaves out archives in several parts and encrypted directories.
"""

import bz2
import hashlib
import io
import lzma
import os
import re
import struct
import zipfile
import zlib
from array import array
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from derender.data.listing import ListedSource, Listing
from derender.data.source import FILE_LIMIT_BYTES

_END = struct.Struct("<4s4H2LH")
_END_64 = struct.Struct("<4sQ2H2L4Q")
_LOCATOR_64 = struct.Struct("<4sLQL")
_ENTRY = struct.Struct("<4s2xBx2H4x3L3H8xL")
_HEADER_BYTES = 30
_LONGEST_COMMENT = 65_535
_NEWEST_VERSION = 63  # of the format, times ten: what is packed for later ones may mean something else
_IN_EXTRA = 0xFFFF_FFFF  # a number of 64 bits stands in the extra field
_LARGEST = 1 << 62  # claims beyond are cut to this, so that sums of two stay whole numbers of 64 bits
_ENCRYPTED, _UTF8_NAME = 1, 0x800
_EMPTY = b"PK\5\6" + bytes(18)
_SMALLEST_DICTIONARY = 4096
_DOUBTFUL = re.compile(r"^[./]|/\.|:|__MACOSX|/$|^$")  # of a million names few are, and are looked at again
_HIDDEN = re.compile(r"(^|/)(\.(?!\.?(/|$))|__MACOSX(/|$))|/$|^$")
_UNSAFE = re.compile(r"^/|^[^/]*:|(^|/)\.\.(/|$)")

# What unpacking raises on damaged members (found by feeding it such).
_UNPACKING_ERRORS = (
    *(OSError, ValueError, EOFError, RuntimeError, MemoryError),
    *(struct.error, zlib.error, lzma.LZMAError, zipfile.BadZipFile),
)


class ZipSource(ListedSource):
    """The members of a zip.

    The numbers are where a member begins, where the next thing in the file does, its bytes packed and
    unpacked, its CRC-32, the format's flags and the number of the way of packing.
    """

    stamped = (3, 4)

    def __init__(self, path: Path):
        self._archive = zipfile.ZipFile(io.BytesIO(_EMPTY))
        self._archive.fp = self._stream = path.open("rb")
        try:
            self._directory = read_directory(self._stream)
            digest = hashlib.blake2b(self._directory[0], digest_size=32)
            digest.update(repr(self._directory[1:]).encode())
            self._proof = {"directory": digest.hexdigest()}
            super().__init__(path)
        except (OSError, ValueError) as problem:
            self._stream.close()
            raise ValueError(
                f"{path} is damaged or not a whole zip file ({problem}); download or copy it again"
            ) from problem
        del self._directory

    def read(self, file: str) -> bytes:
        offset, end, packed, size, crc, flags, method = self.listing.numbers[self.row_of(file)].tolist()
        if size > FILE_LIMIT_BYTES:
            raise ValueError(f"unpacks to {size >> 20:,} MiB, more than {FILE_LIMIT_BYTES >> 20:,} MiB")
        member = zipfile.ZipInfo(self.renamed.get(file, file))
        member.header_offset, member.compress_size, member.flag_bits = offset, packed, flags
        as_stored = method in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)  # zipfile would unpack these without end
        member.file_size, member.compress_type = (packed, zipfile.ZIP_STORED) if as_stored else (size, method)
        try:
            if offset + _HEADER_BYTES + len(member.filename) + packed > end:
                raise ValueError("it reaches into what comes after it")
            with self._archive.open(member) as stream:
                content = stream.read(member.file_size)
            if as_stored:
                content = _unpacked(content, method, size + 1)
            if len(content) != size or zlib.crc32(content) != crc:
                raise ValueError("Bad size or CRC-32")
        except _UNPACKING_ERRORS as problem:
            raise ValueError(f"cannot be unpacked: {problem}") from problem
        return content

    def close(self) -> None:
        self._stream.close()

    @staticmethod
    def shown(name: str) -> str:
        return name.replace("\\", "/")

    def _holds(self, known: Listing) -> bool:
        return known.proof == self._proof

    def _listed(self) -> Listing:
        """The members that are neither hidden, unsafe nor encrypted; of two with one name the later one."""
        names, members = members_of(*self._directory)
        rows: dict[str, int] = {}
        faults: list[tuple[str, str]] = []
        for row, (name, flags) in enumerate(zip(names, members[:, 5].tolist(), strict=True)):
            file = self.shown(name)
            doubtful = _DOUBTFUL.search(file)
            if doubtful and _HIDDEN.search(file):
                continue
            if doubtful and _UNSAFE.search(file):
                faults.append((file, "unsafe name in the zip (absolute or with ..)"))
            elif flags & _ENCRYPTED:
                faults.append((file, "encrypted in the zip"))
            else:
                rows[file] = row
        order = [rows[file] for file in sorted(rows)]
        return Listing(tuple(names[row] for row in order), members[order], sorted(faults), self._proof)


def _unpacked(packed: bytes, method: int, most: int) -> bytes:
    """The content of bzip2 or LZMA, no more of it than ``most`` bytes."""
    if method == zipfile.ZIP_BZIP2:
        return bz2.BZ2Decompressor().decompress(packed, most)
    if packed[2:4] != b"\5\0" or len(packed) < 9:  # the settings stand in the first nine bytes
        raise ValueError("the settings of LZMA are damaged")
    code, dictionary = packed[4], min(int.from_bytes(packed[5:9], "little"), most)
    settings = {"id": lzma.FILTER_LZMA1, "lc": code % 9, "lp": code // 9 % 5, "pb": code // 45}
    settings["dict_size"] = max(_SMALLEST_DICTIONARY, dictionary)
    return lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=[settings]).decompress(packed[9:], most)


def read_directory(stream: io.BufferedIOBase) -> tuple[bytes, int, int]:
    """The directory, where it begins, and how far everything lies behind where it says it does (as in
    archives with a program before them); ValueError where there is none or it is cut short."""
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
    return content, start, start - offset


def members_of(content: bytes, start: int, shift: int) -> tuple[list[str], Int64[np.ndarray, "n 7"]]:
    """The name of every member, cut at its first zero byte, and its row; ValueError if that is damaged."""
    at, last = 0, len(content) - _ENTRY.size
    names: list[str] = []
    numbers = array("q")
    while at <= last:
        entry = _ENTRY.unpack_from(content, at)
        signature, needed, flags, method, crc, packed, size, name, extra, comment, offset = entry
        if signature != b"PK\1\2":
            raise ValueError("its directory is damaged")
        if needed > _NEWEST_VERSION:
            raise ValueError(f"it needs version {needed / 10:.1f} of the format")
        end = at + _ENTRY.size + name
        raw = content[at + _ENTRY.size : end].partition(b"\0")[0]
        names.append(raw.decode("utf-8" if raw.isascii() or flags & _UTF8_NAME else "cp437"))
        if _IN_EXTRA in (size, packed, offset):
            size, packed, offset = _from_extra((size, packed, offset), content[end : end + extra])
        at = end + extra + comment
        numbers.extend((offset + shift, 0, packed, size, crc, flags, method))
    if at != len(content):
        raise ValueError("its directory is cut short")
    members = np.frombuffer(numbers, np.int64).reshape(-1, 7)
    places = np.unique(np.append(members[:, 0], start))
    following = np.searchsorted(places, members[:, 0], "right")
    members[:, 1] = places[np.minimum(following, len(places) - 1)]
    return names, members


def _from_extra(values: tuple[int, ...], extra: bytes) -> list[int]:
    """The values with the 64-bit numbers of the extra field, where only those stand that did not fit."""
    at = 0
    while at + 4 <= len(extra):
        kind, length = struct.unpack_from("<2H", extra, at)
        if kind == 1 and at + 4 + length <= len(extra):
            if length < 8 * values.count(_IN_EXTRA):
                raise ValueError("a number of 64 bits is missing in its directory")
            large = iter(struct.unpack_from(f"<{length // 8}Q", extra, at + 4))
            return [min(next(large), _LARGEST) if value == _IN_EXTRA else value for value in values]
        at += 4 + length
    return list(values)
