"""Where pictures come from: a folder, a zip read in place, or one picture file.

All three answer the same questions: which files are there (sorted by posix path relative to the source),
what is in one of them, and what identifies its present content. Nothing is ever extracted, so a zip with
absolute names or ``..`` in them cannot write anywhere; such members are passed over and listed. Hidden
files and ``__MACOSX`` are left out. Links are followed, each real folder once, so that loops end. Nested
archives are not opened.
"""

import lzma
import stat
import zlib
from abc import ABC, abstractmethod
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from threading import Lock

import numpy as np
from jaxtyping import Int64

from derender.data import listing
from derender.data.kept import kept_file
from derender.data.listing import list_files, recall, remember, stamps_of
from derender.data.names import SUFFIXES, is_hidden, is_picture, printable, suggestion
from derender.data.places import cache_folder
from derender.data.zip_directory import is_zip, read_directory
from derender.data.zip_listing import digest_of, list_zip, recall_zip, remember_zip
from derender.data.zip_member import Member, read_member

FILE_LIMIT_BYTES = 512 << 20
"""No single file larger than this is read: a bound on memory, and on what a zip bomb can unpack to."""

# What unpacking raises on damaged members (found by feeding it such).
_UNPACKING_ERRORS = (OSError, ValueError, EOFError, zlib.error, lzma.LZMAError)


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

    def stamps(self, files: Sequence[str]) -> Int64[np.ndarray, "n 2"]:
        """The stamps of many files, a row for each."""
        return np.array([self.stamp(file) for file in files], np.int64).reshape(-1, 2)

    def remember(self) -> None:  # noqa: B027  (most forget)
        """Keep in the cache folder what makes the next start of a very large source fast."""

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
        """The first file that is no picture with this base name, shallowest first, or None."""
        return self._by_name.get(name)

    @cached_property
    def _by_name(self) -> dict[str, str]:
        """The first file of each base name, shallowest first; without pictures, which may be millions."""
        others = [file for file in self.files if not is_picture(file)]
        deepest_first = sorted(others, key=lambda file: (file.count("/"), file), reverse=True)
        return {file.rpartition("/")[2]: file for file in deepest_first}

    def _rows_of(self, files: Sequence[str]) -> list[int] | slice:
        """The places of files in ``self.files``."""
        if files == self.files:
            return slice(None)
        row_of = {file: row for row, file in enumerate(self.files)}
        return [row_of[file] for file in files]


class FolderSource(Source):
    """Every file below a folder; the listing of a very large one is remembered (data/listing.py)."""

    def __init__(self, folder: Path):
        self.path = folder
        self._kept = kept_file(cache_folder(), folder, "listing")
        self._stamps: np.ndarray | None = None
        known = recall(self._kept, str(folder), is_picture)
        if known is None:
            self._listing = list_files(str(folder), is_hidden).in_order(printable)
        else:
            self._listing, self._stamps, self.recognised = known.listing, known.stamps, known.layout
        self.files = tuple(map(printable, self._listing.files))
        self._real = {
            name: file for name, file in zip(self.files, self._listing.files, strict=True) if name is not file
        }
        faults = [Skipped(printable(file), reason) for file, reason in self._listing.faults]
        self.skipped = tuple(sorted(faults, key=lambda row: row.file))

    def read(self, file: str) -> bytes:
        return read_bounded(self.path / self._real.get(file, file))

    def stamp(self, file: str) -> tuple[int, int]:
        stamps = self._known_stamps()
        if stamps is None:
            status = (self.path / self._real.get(file, file)).stat()
            return status.st_size, status.st_mtime_ns
        size, changed = stamps[bisect_left(self.files, file)].tolist()
        return size, changed

    def stamps(self, files: Sequence[str]) -> Int64[np.ndarray, "n 2"]:
        stamps = self._known_stamps()
        return super().stamps(files) if stamps is None else stamps[self._rows_of(files)]

    def _known_stamps(self) -> np.ndarray | None:
        """The stamps of all files of a very large folder, asked for once and remembered."""
        if self._stamps is None and len(self.files) >= listing.REMEMBERED_FROM:
            self._stamps = stamps_of(str(self.path), self._listing.files)
            remember(self._kept, self._listing, self._stamps, self.recognised)
        return self._stamps


class ZipSource(Source):
    """The members of a zip archive, read in place; the list of a very large one is remembered."""

    def __init__(self, path: Path):
        self.path = path
        self._lock = Lock()
        self._stream = path.open("rb")
        try:
            directory = read_directory(self._stream)
            self._digest = digest_of(directory)
            self._kept = kept_file(cache_folder(), path, "listing")
            known = recall_zip(self._kept, self._digest)
            self._listing = list_zip(directory) if known is None else known.listing
        except (OSError, ValueError) as problem:
            self._stream.close()
            raise ValueError(
                f"{path} is damaged or not a whole zip file ({problem}); download or copy it again"
            ) from problem
        self._remembered = None if known is None else known.layout
        self.recognised = self._remembered or ""
        self.files = self._listing.files
        self.skipped = tuple(Skipped(file, reason) for file, reason in self._listing.faults)

    def read(self, file: str) -> bytes:
        member = Member(*self._listing.members[self._row(file)].item())
        if member.size > FILE_LIMIT_BYTES:
            raise ValueError(
                f"unpacks to {member.size >> 20:,} MiB, more than {FILE_LIMIT_BYTES >> 20:,} MiB"
            )
        try:
            return read_member(self._stream, self._lock, member, file)
        except _UNPACKING_ERRORS as problem:
            raise ValueError(f"cannot be unpacked: {problem}") from problem

    def stamp(self, file: str) -> tuple[int, int]:
        member = self._listing.members[self._row(file)]
        return int(member["size"]), int(member["crc"])

    def stamps(self, files: Sequence[str]) -> Int64[np.ndarray, "n 2"]:
        members = self._listing.members[self._rows_of(files)]
        return np.stack([members["size"], members["crc"].astype(np.int64)], axis=1)

    def remember(self) -> None:
        if len(self.files) >= listing.REMEMBERED_FROM and self._remembered != self.recognised:
            remember_zip(self._kept, self._digest, self._listing, self.recognised)
            self._remembered = self.recognised

    def _row(self, file: str) -> int:
        row = bisect_left(self.files, file)
        if row == len(self.files) or self.files[row] != file:
            raise ValueError(f"{file} is not in {self.path}")
        return row

    def close(self) -> None:
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
    if path.is_file() and (path.suffix.lower() == ".zip" or is_zip(path)):
        return ZipSource(path)
    raise ValueError(
        f"{path} is no folder, zip or picture ({' '.join(SUFFIXES)}); unpack other archives into a folder"
    )


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


def nearest_sibling(path: Path) -> str:
    """For "does not exist": a folder, archive or picture beside it that is called nearly so."""
    parent = path.absolute().parent
    if not parent.is_dir():
        return f"; nor does its folder {parent}"
    try:
        beside = sorted(entry.name for entry in parent.iterdir() if _may_hold_pictures(entry))
    except OSError:
        return ""
    return suggestion(path.name, beside)


def _may_hold_pictures(path: Path) -> bool:
    return is_picture(path.name) or path.suffix.lower() in (".zip", ".tar") or path.is_dir()
