"""Named files that are read by name: the interface of folders, zips, tables and single images.

Names are posix paths relative to the source, sorted. Nothing is ever extracted, so that no name in an archive
can write anywhere. A folder is walked once: hidden files and ``__MACOSX`` are left out, and links are
followed, each real folder once, so that loops end.

Members of a zip with absolute names or ``..`` in them, encrypted ones and those packed by bzip2 or LZMA are
passed over and listed. Refused are another size or CRC-32 than in the directory, and a size beyond
``FILE_LIMIT_BYTES``. So is a member that reaches into the next: members within each other let small archives
unpack to endless ones.

A parquet file is opened only if what its footer claims can be: readers reserve memory for as many rows as it
names. Leaves out the pages behind the footer and the columns of single row groups: of a damaged footer
pyarrow 26 looks at those with C++ exceptions that end the process.
"""

import os
import re
import stat
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from posixpath import basename, dirname
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from jaxtyping import Int64

from derender.data.image import DECODER_ERRORS, HEAD_BYTES, LARGE_BYTES, Unreadable, refuse_by_header
from derender.storage.bounded import FILE_LIMIT_BYTES, read_bounded
from derender.storage.places import SUFFIXES

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

_HEADER_BYTES = 30
_PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_HIDDEN = re.compile(r"(^|/)(\.(?!\.?(/|$))|__MACOSX(/|$))|/$|^$")
_UNSAFE = re.compile(r"^/|^[^/]*:|(^|/)\.\.(/|$)")

ALWAYS_ALLOWED_BYTES = 512 * 2**20
MOST_EXPANSION = 1000  # files of equal features expand hundreds of times, those of real ones not ten times


@dataclass(frozen=True)
class Skipped:
    """A file that is no part of the result, and why."""

    file: str
    reason: str


C = TypeVar("C", bound="Closing")


class Closing:
    """What may hold files open until it is closed, or left as a context."""

    def close(self) -> None:
        """Release what is held open."""

    def __enter__(self: C) -> C:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


class Source(Closing, ABC):
    """Named files, read by name."""

    path: Path  # the folder or file that the user named
    files: tuple[str, ...]  # every regular file, as sorted posix paths relative to the source
    skipped: tuple[Skipped, ...] = ()  # not to be opened: unsafe names, broken links, encrypted

    @abstractmethod
    def read(self, file: str) -> bytes:
        """The whole content of one file; at most ``FILE_LIMIT_BYTES``. Safe to call from several threads."""

    @abstractmethod
    def stamps(self, files: Sequence[str]) -> Int64[np.ndarray, "n 2"]:
        """Two numbers a file that change with its content: its size, and checksum or time of change."""

    def size(self, file: str) -> int:
        """The bytes of one file, unpacked."""
        return int(self.stamps((file,))[0, 0])

    @cached_property
    def images(self) -> tuple[str, ...]:
        """The files with an image's suffix."""
        return tuple(file for file in self.files if is_image(file))

    def images_in(self, folder: str) -> list[str]:
        """The images in folders of that name."""
        return [file for file in self.images if parent_name(file) == folder]

    @cached_property
    def _by_name(self) -> dict[str, str]:
        others = [file for file in self.files if not is_image(file)]  # of images there may be millions
        deepest_first = sorted(others, key=lambda file: (file.count("/"), file), reverse=True)
        return {file.rpartition("/")[2]: file for file in deepest_first}

    def named(self, *names: str) -> str | None:
        """The file with the first of these base names that is there, shallowest first; images aside."""
        return next((self._by_name[name] for name in names if name in self._by_name), None)

    def read_text(self, file: str) -> str:
        """One file as text: UTF-8, with or without a byte order mark."""
        try:
            return self.read(file).decode("utf-8-sig")
        except UnicodeDecodeError as problem:
            fault = f"is not UTF-8 text ({problem.reason}); save it as UTF-8"
            raise ValueError(f"{file} in {self.path} {fault}") from problem


class FileSource(Source):
    """Files beside one another on disk; a single image is the usual case."""

    def __init__(self, path: Path):
        self.path, self._folder = path, path.parent
        self.files = (printable(path.name),)
        self._on_disk = {self.files[0]: path.name}  # the name that a file has on disk, where that differs

    def on_disk(self, file: str) -> Path:
        """Where a file lies."""
        return self._folder / self._on_disk.get(file, file)

    def read(self, file: str) -> bytes:
        return read_bounded(self.on_disk(file), FILE_LIMIT_BYTES)

    def stamps(self, files: Sequence[str]) -> Int64[np.ndarray, "n 2"]:
        return stamps_of(map(self.on_disk, files))


class FolderSource(FileSource):
    """Every file below a folder."""

    def __init__(self, path: Path):
        self.path = self._folder = path
        self._on_disk = {}
        faults: dict[str, str] = {}  # what is no file, and why
        seen: set[tuple[int, int]] = set()

        def unlisted(problem: OSError) -> None:
            here = Path(problem.filename).relative_to(path).as_posix()
            faults[here] = f"folder cannot be listed: {problem.strerror}"

        for folder, below, names in os.walk(path, onerror=unlisted, followlinks=True):
            here, status = Path(folder).relative_to(path).as_posix(), Path(folder).stat()
            entries = [name for name in names if not is_hidden(name)]
            if is_run := here != "." and {"config.yaml", "environment.json"}.issubset(entries):
                faults[here] = "a run folder: its sheets are no images to read"
            if is_run or (status.st_dev, status.st_ino) in seen:
                entries, below[:] = [], []
            seen.add((status.st_dev, status.st_ino))
            below[:] = sorted(name for name in below if not is_hidden(name))
            for entry in entries:
                name = entry if here == "." else f"{here}/{entry}"
                try:
                    if stat.S_ISREG(os.stat(f"{path}/{name}").st_mode):  # noqa: PTH116  (a million times)
                        self._on_disk[printable(name)] = name
                    else:
                        faults[name] = "not a regular file"
                except OSError as problem:
                    faults[name] = f"broken link or unreachable file: {problem.strerror}"
        self.files = tuple(sorted(self._on_disk))
        self.skipped = tuple(Skipped(printable(name), faults[name]) for name in sorted(faults))


class ZipSource(Source):
    """The members of a zip that are not hidden, unsafe, encrypted or packed in a way of their own."""

    def __init__(self, path: Path):
        self.path = path
        try:
            self._archive = zipfile.ZipFile(path)
        except DECODER_ERRORS as problem:
            fault = f"is damaged or not a whole zip file ({problem}); download or copy it again"
            raise ValueError(f"{path} {fault}") from problem
        self._members: dict[str, zipfile.ZipInfo] = {}
        faults: set[tuple[str, str]] = set()
        for member in self._archive.infolist():
            file = member.filename.replace("\\", "/")
            if _HIDDEN.search(file):
                continue
            if _UNSAFE.search(file):
                faults.add((file, "unsafe name in the zip (absolute or with ..)"))
            elif member.flag_bits & 1:
                faults.add((file, "encrypted in the zip"))
            elif member.compress_type not in _PACKINGS:
                faults.add((file, "packed by bzip2, LZMA or the like: pack the zip by deflate, as usual"))
            else:
                self._members[file] = member  # of two with one name the later
        self.files = tuple(sorted(self._members))
        self.skipped = tuple(Skipped(*fault) for fault in sorted(faults))
        begins = sorted({member.header_offset for member in self._archive.infolist()})
        self._following = dict(pairwise([*begins, self._archive.start_dir]))

    def read(self, file: str) -> bytes:
        member = self._members[file]
        size = member.file_size
        if size > FILE_LIMIT_BYTES:
            raise ValueError(f"unpacks to {size >> 20:,} MiB, more than {FILE_LIMIT_BYTES >> 20:,} MiB")
        end = member.header_offset + _HEADER_BYTES + len(member.orig_filename) + member.compress_size
        try:
            if end > self._following[member.header_offset]:
                raise ValueError("it reaches into what comes after it")
            with self._archive.open(member) as stream:
                content = stream.read(min(size, HEAD_BYTES))
                if size > LARGE_BYTES and is_image(file):
                    refuse_by_header(content, size)
                content += stream.read(size - len(content))  # without a number it would never end
            if len(content) != size:
                raise ValueError("it is shorter than the directory says")
        except Unreadable:
            raise
        except DECODER_ERRORS as problem:
            raise ValueError(f"cannot be unpacked: {problem}") from problem
        return content

    def stamps(self, files: Sequence[str]) -> Int64[np.ndarray, "n 2"]:
        members = (self._members[file] for file in files)
        return np.array([(one.file_size, one.CRC) for one in members], np.int64).reshape(-1, 2)

    def close(self) -> None:
        self._archive.close()


def stamps_of(paths: Iterable[Path]) -> Int64[np.ndarray, "n 2"]:
    """Size and time of change in nanoseconds of files on disk."""
    results = [path.stat() for path in paths]
    return np.array([(one.st_size, one.st_mtime_ns) for one in results], np.int64).reshape(-1, 2)


def evenly_spaced(count: int, limit: int | None) -> Int64[np.ndarray, " k"]:
    """Rows of a list of ``count``: all, or as many as ``limit``, the first and the last among them."""
    return np.linspace(0, count - 1, count if limit is None else min(count, limit)).astype(int)


def is_image(file: str) -> bool:
    """Whether the name has an image's suffix."""
    return file.lower().endswith(SUFFIXES)


def stem_of(file: str) -> str:
    """A file's name without its folders and its suffix."""
    return basename(file).rsplit(".", 1)[0]


def parent_name(file: str) -> str:
    """The name of the folder that a file lies in, "" at the top."""
    return basename(dirname(file))


def is_hidden(name: str) -> bool:
    """Whether a file or folder of this name is left out."""
    return name.startswith(".") or name == "__MACOSX"


def printable(name: str) -> str:
    """The name with bytes that are not UTF-8 as backslash escapes, so that it can be stored anywhere."""
    return name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def opened_parquet(file: Path | bytes) -> "pq.ParquetFile":
    """The file, or content of a file, opened and not yet read.

    Raises:
        pyarrow.ArrowException, OSError: it is no parquet file.
        ValueError: its numbers of rows contradict each other, or its values need more than 512 MiB and more
            than 1000 times the file's size.
    """
    import pyarrow.parquet as pq

    size = len(file) if isinstance(file, bytes) else file.stat().st_size
    source = BytesIO(file) if isinstance(file, bytes) else file
    opened = pq.ParquetFile(source, page_checksum_verification=True)
    groups = [opened.metadata.row_group(place).num_rows for place in range(opened.metadata.num_row_groups)]
    rows = opened.metadata.num_rows
    if min(groups, default=0) < 0 or sum(groups) != rows:
        raise ValueError(f"{rows:,} rows, its parts have {sum(groups):,}")
    taken = rows * sum(map(_bytes_of, opened.schema_arrow.types))
    if taken > max(ALWAYS_ALLOWED_BYTES, MOST_EXPANSION * size):
        raise ValueError(f"{taken:,} bytes of values in a file of {size:,}")
    return opened


def _bytes_of(kind: "pa.DataType") -> int:
    """Bytes that a value of this kind takes: a text and a list of any length count as one number."""
    import pyarrow as pa

    if pa.types.is_fixed_size_list(kind):
        return kind.list_size * _bytes_of(kind.value_type)
    if pa.types.is_struct(kind):
        return sum(_bytes_of(field.type) for field in kind)
    return kind.byte_width if pa.types.is_fixed_size_binary(kind) else 8
