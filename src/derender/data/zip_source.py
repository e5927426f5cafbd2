"""The members of a zip archive, read in place with Python's ``zipfile``.

Members with absolute names or ``..`` in them and encrypted ones are passed over and listed. Refused are a
member that reaches into what comes after it (members within each other are how small archives unpack to
endless ones), another size or CRC-32 than in the directory, and a size beyond ``FILE_LIMIT_BYTES``.
"""

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

from derender.data.source import FILE_LIMIT_BYTES, Skipped, Source

_HEADER_BYTES = 30
_ENCRYPTED = 1
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
        if member.file_size > FILE_LIMIT_BYTES:
            raise ValueError(
                f"unpacks to {member.file_size >> 20:,} MiB, more than {FILE_LIMIT_BYTES >> 20:,} MiB"
            )
        end = member.header_offset + _HEADER_BYTES + len(member.orig_filename) + member.compress_size
        try:
            if end > self._following[member.header_offset]:
                raise ValueError("it reaches into what comes after it")
            with self._archive.open(member) as stream:
                content = stream.read(member.file_size)  # without a number it would unpack without end
            if len(content) != member.file_size:
                raise ValueError("it is shorter than the directory says")
        except _UNPACKING_ERRORS as problem:
            raise ValueError(f"cannot be unpacked: {problem}") from problem
        return content

    def stamps(self, files: Sequence[str]) -> Int64[np.ndarray, "n 2"]:
        members = (self._members[file] for file in files)
        return np.array([(one.file_size, one.CRC) for one in members], np.int64).reshape(-1, 2)

    def close(self) -> None:
        self._archive.close()
