"""Where pictures come from: a folder, a zip read in place, or one picture file.

All three answer the same questions: which files are there (sorted by posix path relative to the source),
what is in one of them, and what identifies its present content. Nothing is ever extracted, so a zip with
absolute names or ``..`` in them cannot write anywhere; such members are passed over and listed. Hidden
files and ``__MACOSX`` are left out. Links are followed, each real folder once, so that loops end. Nested
archives are not opened.
"""

import lzma
import stat
import struct
import zipfile
import zlib
from abc import ABC, abstractmethod
from bisect import bisect_left
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from derender.data import listing
from derender.data.listing import list_files, listing_file, recall, remember, stamps_of
from derender.data.nearest import nearest
from derender.data.places import cache_folder

SUFFIXES = (
    *(".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".webp", ".avif", ".bmp", ".gif"),
    *(".tif", ".tiff", ".ppm", ".pgm", ".pnm"),
)
"""File names that end in one of these are taken for pictures."""

FILE_LIMIT_BYTES = 512 << 20
"""No single file larger than this is read: a bound on memory, and on what a zip bomb can unpack to."""

# What the zip reader raises on damaged archives (found by feeding it such). NotImplementedError, for
# a way of packing that Python does not know, is a RuntimeError; names that are not text give a ValueError.
_ZIP_ERRORS = (
    zipfile.BadZipFile,
    OSError,
    RuntimeError,
    ValueError,
    EOFError,
    OverflowError,
    struct.error,
    zlib.error,
    lzma.LZMAError,
)


@dataclass(frozen=True)
class Skipped:
    """A file that is no part of the result, and why."""

    file: str
    reason: str


class Source(ABC):
    """Named files, read by name.

    Attributes:
        path: the folder or file that the user named.
        files: every regular file, as sorted posix paths relative to the source.
        skipped: files that cannot even be opened (unsafe names, broken links, no permission, encrypted).
        recognised: the layout that it was recognised as, "" until then.
    """

    path: Path
    files: tuple[str, ...]
    skipped: tuple[Skipped, ...] = ()
    recognised: str = ""

    @abstractmethod
    def read(self, file: str) -> bytes:
        """The whole content of one file; at most ``FILE_LIMIT_BYTES``. Safe to call from several threads."""

    @abstractmethod
    def stamp(self, file: str) -> tuple[int, int]:
        """Two numbers that change when the file's content does: size, and checksum or time of change."""

    @cached_property
    def pictures(self) -> tuple[str, ...]:
        """The files with a picture's suffix."""
        return tuple(file for file in self.files if is_picture(file))

    def close(self) -> None:  # noqa: B027  (folders hold nothing open)
        """Release what the source holds open."""

    def __enter__(self) -> "Source":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def read_text(self, file: str) -> str:
        """One file as text: UTF-8, with or without a byte order mark."""
        try:
            return self.read(file).decode("utf-8-sig")
        except UnicodeDecodeError as problem:
            raise ValueError(
                f"{file} in {self.path} is not UTF-8 text ({problem.reason}); save it as UTF-8"
            ) from problem

    def named(self, name: str) -> str | None:
        """The first file with this base name, shallowest first, or None."""
        return self._by_name.get(name)

    @cached_property
    def _by_name(self) -> dict[str, str]:
        """The first file of each base name, shallowest first."""
        deepest_first = sorted(self.files, key=lambda file: (file.count("/"), file), reverse=True)
        return {file.rpartition("/")[2]: file for file in deepest_first}


class FolderSource(Source):
    """Every file below a folder; the listing of a very large one is remembered (data/listing.py)."""

    def __init__(self, folder: Path):
        self.path = folder
        self._kept = listing_file(cache_folder(), folder)
        self._stamps: np.ndarray | None = None
        known = recall(self._kept, str(folder), is_picture)
        if known is None:
            found = list_files(str(folder), is_hidden)
            self._listing = replace(found, files=tuple(sorted(found.files, key=printable)))
        else:
            self._listing, self._stamps, self.recognised = known.listing, known.stamps, known.layout
        self.files = tuple(printable(file) for file in self._listing.files)
        self._real = {
            name: file for name, file in zip(self.files, self._listing.files, strict=True) if name is not file
        }
        faults = [Skipped(printable(file), reason) for file, reason in self._listing.faults]
        self.skipped = tuple(sorted(faults, key=lambda row: row.file))

    def read(self, file: str) -> bytes:
        return read_bounded(self.path / self._real.get(file, file))

    def stamp(self, file: str) -> tuple[int, int]:
        if self._stamps is None and len(self.files) >= listing.REMEMBERED_FROM:
            self._stamps = stamps_of(str(self.path), self._listing.files)
            remember(self._kept, self._listing, self._stamps, self.recognised)
        if self._stamps is None:
            status = (self.path / self._real.get(file, file)).stat()
            return status.st_size, status.st_mtime_ns
        size, changed = self._stamps[bisect_left(self.files, file)].tolist()
        return size, changed


class ZipSource(Source):
    """The members of a zip archive, read in place."""

    def __init__(self, path: Path):
        self.path = path
        self._stream = path.open("rb")
        try:
            self._archive = zipfile.ZipFile(self._stream)
        except _ZIP_ERRORS as problem:
            self._stream.close()
            raise ValueError(
                f"{path} is damaged or not a whole zip file ({problem}); download or copy it again"
            ) from problem
        self._members: dict[str, zipfile.ZipInfo] = {}
        skipped: list[Skipped] = []
        for member in self._archive.infolist():
            file = member.filename.replace("\\", "/")
            if _ordinary(file) and not member.flag_bits & 1:
                if not file.endswith("/"):
                    self._members[printable(file)] = member
                continue
            parts = file.split("/")
            hidden = any(is_hidden(part) for part in parts if part not in ("", ".", ".."))
            if hidden or not file or member.is_dir():
                continue
            if file.startswith("/") or ".." in parts or ":" in parts[0]:
                skipped.append(Skipped(file, "unsafe name in the zip (absolute or with ..)"))
            elif member.flag_bits & 1:
                skipped.append(Skipped(file, "encrypted in the zip"))
            else:
                self._members[printable(file)] = member
        self.files = tuple(sorted(self._members))
        self.skipped = tuple(sorted(skipped, key=lambda row: row.file))

    def read(self, file: str) -> bytes:
        member = self._members[file]
        if member.file_size > FILE_LIMIT_BYTES:
            raise ValueError(
                f"unpacks to {member.file_size >> 20:,} MiB, more than {FILE_LIMIT_BYTES >> 20:,} MiB"
            )
        try:
            return self._archive.read(member)
        except _ZIP_ERRORS as problem:
            raise ValueError(f"cannot be unpacked: {problem}") from problem

    def stamp(self, file: str) -> tuple[int, int]:
        member = self._members[file]
        return member.file_size, member.CRC

    def close(self) -> None:
        self._archive.close()
        self._stream.close()


class FileSource(Source):
    """One picture."""

    def __init__(self, path: Path):
        self.path = path
        self.files = (printable(path.name),)

    def read(self, file: str) -> bytes:
        return read_bounded(self.path)

    def stamp(self, file: str) -> tuple[int, int]:
        status = self.path.stat()
        return status.st_size, status.st_mtime_ns


def open_source(path: Path) -> Source:
    """Open a folder, a zip or a picture; anything else is an error that says what to give instead."""
    if not path.exists():
        raise ValueError(f"{path} does not exist{nearest_sibling(path)}")
    if path.is_dir():
        return FolderSource(path)
    if path.suffix.lower() in SUFFIXES:
        return FileSource(path)
    if zipfile.is_zipfile(path) or path.suffix.lower() == ".zip":
        return ZipSource(path)
    raise ValueError(
        f"{path} is no folder, zip or picture ({' '.join(SUFFIXES)}); unpack other archives into a folder"
    )


def is_picture(file: str) -> bool:
    """Whether the name has a picture's suffix."""
    stem, dot, suffix = file.rpartition("/")[2].rpartition(".")
    return bool(stem) and f"{dot}{suffix}".lower() in SUFFIXES


def read_bounded(path: Path) -> bytes:
    """A file's content; ValueError when it is no regular file or larger than ``FILE_LIMIT_BYTES``."""
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):  # a pipe may never end, a device never does
        raise ValueError("not a regular file")
    size = status.st_size
    if size > FILE_LIMIT_BYTES:
        raise ValueError(f"file of {size >> 20:,} MiB is larger than {FILE_LIMIT_BYTES >> 20:,} MiB")
    with path.open("rb") as stream:
        content = stream.read(size + 1)
    if len(content) > size:
        raise ValueError("the file grew while it was read")
    return content


def _ordinary(file: str) -> bool:
    """Whether a zip's name is plainly neither hidden nor unsafe; most are, and a zip may have a million."""
    odd = not file or file.startswith((".", "/")) or "/." in file or ":" in file or "__MACOSX" in file
    return not odd


def is_hidden(name: str) -> bool:
    return name.startswith(".") or name == "__MACOSX"


def printable(name: str) -> str:
    """The name with bytes that are not UTF-8 as backslash escapes, so that it can be stored anywhere."""
    return name if name.isascii() else _escaped(name)


def _escaped(name: str) -> str:
    escaped = name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
    return name if escaped == name else escaped


def nearest_sibling(path: Path) -> str:
    """For "does not exist": a folder, archive or picture beside it that is called nearly so."""
    parent = path.absolute().parent
    if not parent.is_dir():
        return f"; nor does its folder {parent}"
    try:
        beside = sorted(entry.name for entry in parent.iterdir() if _may_hold_pictures(entry))
    except OSError:
        return ""
    return nearest(path.name, beside)


def _may_hold_pictures(path: Path) -> bool:
    return is_picture(path.name) or path.suffix.lower() in (".zip", ".tar") or path.is_dir()
