"""The members of a zip archive, read in place with Python's ``zipfile``.

Members with absolute names or ``..`` in them and encrypted ones are passed over and listed. Refused are
another size or CRC-32 than in the directory, and a size beyond ``FILE_LIMIT_BYTES``. So is a member that
reaches into the next: members within each other let small archives unpack to endless ones.
"""

import bz2
import lzma
import re
import struct
import zipfile
import zlib
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from derender.data.image import HEAD_BYTES, LARGE_BYTES, Unreadable, refuse_by_header
from derender.data.source import FILE_LIMIT_BYTES, Skipped, Source, is_image

_HEADER_BYTES = 30
_ENCRYPTED, _STEP = 1, 4096
_HIDDEN = re.compile(r"(^|/)(\.(?!\.?(/|$))|__MACOSX(/|$))|/$|^$")
_UNSAFE = re.compile(r"^/|^[^/]*:|(^|/)\.\.(/|$)")

# What unpacking raises on damaged members (found by feeding it such).
_UNPACKING_ERRORS = (
    *(OSError, ValueError, LookupError, EOFError, RuntimeError, MemoryError, OverflowError),
    *(struct.error, zlib.error, lzma.LZMAError, zipfile.BadZipFile),
)


class ZipSource(Source):
    """The members of a zip that are neither hidden, unsafe nor encrypted; of two with one name the later."""

    def __init__(self, path: Path):
        self.path = path
        try:
            self._archive = zipfile.ZipFile(path)
        except _UNPACKING_ERRORS as problem:
            raise ValueError(
                f"{path} is damaged or not a whole zip file ({problem}); download or copy it again"
            ) from problem
        self._members: dict[str, zipfile.ZipInfo] = {}
        faults: set[tuple[str, str]] = set()
        for member in self._archive.infolist():
            file = member.filename.replace("\\", "/")
            if _HIDDEN.search(file):
                continue
            if _UNSAFE.search(file):
                faults.add((file, "unsafe name in the zip (absolute or with ..)"))
            elif member.flag_bits & _ENCRYPTED:
                faults.add((file, "encrypted in the zip"))
            else:
                self._members[file] = member
        self.files = tuple(sorted(self._members))
        self.skipped = tuple(Skipped(*fault) for fault in sorted(faults))
        begins = sorted({member.header_offset for member in self._archive.infolist()})
        self._following = dict(pairwise([*begins, self._archive.start_dir]))

    def read(self, file: str) -> bytes:
        member = self._members[file]
        size, as_asked = member.file_size, member.compress_type in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
        large = size > LARGE_BYTES and is_image(file)
        most = LARGE_BYTES if large and not as_asked else FILE_LIMIT_BYTES
        if size > most:
            raise ValueError(f"unpacks to {size >> 20:,} MiB, more than {most >> 20:,} MiB")
        end = member.header_offset + _HEADER_BYTES + len(member.orig_filename) + member.compress_size
        try:
            if end > self._following[member.header_offset]:
                raise ValueError("it reaches into what comes after it")
            if member.compress_type == zipfile.ZIP_BZIP2:
                content = self._from_bzip2(member)
            else:
                with self._archive.open(member) as stream:
                    content = stream.read(min(size, HEAD_BYTES if as_asked else _STEP))
                    if large:
                        refuse_by_header(content, size)
                    if as_asked:
                        content += stream.read(size - len(content))  # without a number it would never end
                    else:  # the fewer packed bytes zipfile reads, the less it unpacks at once
                        content += b"".join(stream.read(_STEP) for _ in range(0, size - len(content), _STEP))
            if len(content) != size:
                raise ValueError("it is shorter than the directory says")
        except Unreadable:
            raise
        except _UNPACKING_ERRORS as problem:
            raise ValueError(f"cannot be unpacked: {problem}") from problem
        return content

    def _from_bzip2(self, member: zipfile.ZipInfo) -> bytes:
        """The content, no more of it than the directory says: zipfile would unpack 4 KB to gigabytes."""
        packed = zipfile.ZipInfo(member.orig_filename)
        packed.header_offset, packed.flag_bits = member.header_offset, member.flag_bits
        packed.compress_size = packed.file_size = member.compress_size
        with self._archive.open(packed) as stream:
            content = bz2.BZ2Decompressor().decompress(
                stream.read(member.compress_size), member.file_size + 1
            )
        if zlib.crc32(content) != member.CRC:
            raise ValueError("its CRC-32 is not that of the directory")
        return content

    def stamps(self, files: Sequence[str]) -> Int64[np.ndarray, "n 2"]:
        members = (self._members[file] for file in files)
        return np.array([(one.file_size, one.CRC) for one in members], np.int64).reshape(-1, 2)

    def close(self) -> None:
        self._archive.close()
