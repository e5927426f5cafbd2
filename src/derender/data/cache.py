"""Keeps decoded pictures of a large data set in one file that is mapped into memory.

The file is the rows themselves, then a JSON note (what they were made from, which files they are), then the
note's length and a mark. It is written under another name and moved into place when complete, so a reader
never sees half of one. It counts only if the note's fingerprint is that of the source as it is now (name,
size, and checksum or time of change of every file, and every setting), its length is right, and a sample of
its rows has the recorded checksum; otherwise it is made again. One file per source and setting: a new
version takes the old one's place. Rows of a stream are appended one after the other, since nobody knows how
many there will be; their labels stand in the note.
"""

import hashlib
import json
import os
import tempfile
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
import PIL
from jaxtyping import UInt8

from derender.data.duplicates import Duplicate
from derender.data.loading import Loaded
from derender.data.source import Skipped, Source

_MARK = b"derender pictures 1\n"
_SAMPLED_ROWS = 64
_HASHED_AT_ONCE = 10_000


@dataclass(frozen=True)
class Cached:
    """What a cache file holds.

    Attributes:
        images: the rows, as a private memory map: writing to it changes no file.
        loaded: which files they are, and what became of the others.
        further: what else was noted when they were written.
    """

    images: UInt8[np.ndarray, "n 3 s s"]
    loaded: Loaded
    further: dict[str, Any] = field(default_factory=dict)


def fingerprint(source: Source, files: tuple[str, ...], settings: tuple[object, ...]) -> str:
    """Changes whenever the decoded rows would: with any file's content, the order, or a setting."""
    digest = hashlib.sha256(repr((settings, PIL.__version__)).encode())
    stamps = source.stamps(files)
    for first in range(0, len(files), _HASHED_AT_ONCE):
        some = slice(first, first + _HASHED_AT_ONCE)
        rows = zip(files[some], stamps[some, 0].tolist(), stamps[some, 1].tolist(), strict=True)
        digest.update("".join(f"({file!r}, ({one}, {other}))" for file, one, other in rows).encode("utf-8"))
    return digest.hexdigest()


def cache_file(folder: Path, name: str, key: tuple[object, ...]) -> Path:
    """Where rows are kept: a source's name for people, and everything that tells it from others."""
    digest = hashlib.sha256(repr(key).encode("utf-8", "backslashreplace")).hexdigest()
    return folder / f"{name[:40]}-{digest[:16]}.pictures"


def read_cache(file: Path, expected: str, image_size: int) -> Cached | None:
    """What the file holds, or None if there is none or it was made of something else."""
    try:
        with file.open("rb") as stream:
            end = stream.seek(-len(_MARK) - 8, os.SEEK_END)
            length = int.from_bytes(stream.read(8), "little")
            if stream.read() != _MARK or length > end:
                return None
            stream.seek(end - length)
            note = json.loads(stream.read(length))
        found, checksum, further = note["fingerprint"], note["checksum"], note.get("further", {})
        loaded = Loaded(
            tuple(note["files"]),
            tuple(Skipped(**row) for row in note["skipped"]),
            tuple(Duplicate(**row) for row in note["duplicates"]),
        )
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return None
    count = len(loaded.files)
    if found != expected or end - length != count * 3 * image_size * image_size or not count:
        return None
    images = np.memmap(file, np.uint8, mode="c", shape=(count, 3, image_size, image_size))
    if sample_checksum(images) != checksum:
        return None
    return Cached(images, loaded, further)


@contextmanager
def new_cache(file: Path, count: int, image_size: int) -> Iterator["CacheWriter"]:
    """Room for ``count`` rows beside ``file``; what is not finished is deleted."""
    needed = count * 3 * image_size * image_size
    with _draft(file, needed) as draft:
        yield CacheWriter(
            file, draft, np.memmap(draft, np.uint8, mode="r+", shape=(count, 3, image_size, image_size))
        )


@contextmanager
def growing_cache(file: Path, image_size: int) -> Iterator["GrowingCache"]:
    """A draft beside ``file`` that rows are appended to; what is not finished is deleted."""
    with _draft(file, 0) as draft, draft.open("ab") as stream:
        yield GrowingCache(file, draft, stream, image_size)


@contextmanager
def _draft(file: Path, needed: int) -> Iterator[Path]:
    """An unfinished file of this many bytes beside ``file``."""
    draft = None
    try:
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            _remove_abandoned(file)
            handle, name = tempfile.mkstemp(prefix=f".{file.name}.", dir=file.parent)
            draft = Path(name)
            with os.fdopen(handle, "r+b") as stream:
                if needed:
                    _reserve(stream.fileno(), needed)
        except OSError as problem:
            raise _no_room(file, needed, problem) from problem
        yield draft
    finally:
        if draft is not None:
            draft.unlink(missing_ok=True)


def _no_room(file: Path, needed: int, problem: OSError) -> OSError:
    return OSError(
        f"cannot keep {needed / 1e9:.3g} GB of decoded pictures in {file.parent} "
        f"({problem.strerror or problem}); "
        "set DERENDER_CACHE to a folder on another disk, or ask for smaller pictures"
    )


def _remove_abandoned(file: Path) -> None:
    """Delete drafts of this file that a killed process left behind more than a day ago."""
    for draft in file.parent.iterdir():
        if draft.name.startswith(f".{file.name}.") and draft.stat().st_mtime < time.time() - 86_400:
            draft.unlink(missing_ok=True)


def _reserve(handle: int, size: int) -> None:
    """Claim disk blocks now: writing through a map to a full disk would kill the process."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(handle, 0, size)
    else:
        os.truncate(handle, size)


class CacheWriter:
    """Rows being written; ``finish`` puts them in place."""

    def __init__(self, file: Path, draft: Path, rows: np.memmap):
        self.file = file
        self.draft = draft
        self.rows = rows

    def finish(self, loaded: Loaded, mark: str) -> None:
        """Cut the file to the rows that count, append the note, and move it into place."""
        kept = self.rows[: len(loaded.files)]
        self.rows.flush()
        _seal(self.file, self.draft, kept, loaded, mark, {})


class GrowingCache:
    """Rows being appended; ``finish`` puts them in place."""

    def __init__(self, file: Path, draft: Path, stream: IO[bytes], image_size: int):
        self.file = file
        self.draft = draft
        self._stream = stream
        self._size = image_size

    def append(self, rows: UInt8[np.ndarray, "n 3 s s"]) -> None:
        """Write some rows behind those that are there."""
        try:
            self._stream.write(np.ascontiguousarray(rows).data)
        except OSError as problem:
            raise _no_room(self.file, self._stream.tell(), problem) from problem

    def finish(self, loaded: Loaded, mark: str, further: dict[str, Any]) -> None:
        """Append the note, and move the file into place; ``further`` is anything JSON can hold."""
        self._stream.flush()
        kept = np.memmap(self.draft, np.uint8, mode="r", shape=(len(loaded.files), 3, self._size, self._size))
        _seal(self.file, self.draft, kept, loaded, mark, further)


def _seal(
    file: Path, draft: Path, kept: np.ndarray, loaded: Loaded, mark: str, further: dict[str, Any]
) -> None:
    """Cut a draft to the rows that count, append the note, and move it into place."""
    note = {
        "fingerprint": mark,
        "checksum": sample_checksum(kept),
        **asdict(loaded),
        **({"further": further} if further else {}),
    }
    encoded = json.dumps(note).encode()
    try:
        with draft.open("r+b") as stream:
            stream.truncate(kept.size)
            stream.seek(0, os.SEEK_END)
            stream.write(encoded + len(encoded).to_bytes(8, "little") + _MARK)
            stream.flush()
            os.fsync(stream.fileno())
        draft.replace(file)
    except OSError as problem:
        raise _no_room(file, kept.size, problem) from problem


def sample_checksum(rows: np.ndarray) -> int:
    """CRC of at most 64 rows, evenly spaced, the first and the last among them."""
    chosen = np.unique(np.linspace(0, len(rows) - 1, _SAMPLED_ROWS).astype(int)) if len(rows) else []
    checksum = 0
    for row in chosen:
        checksum = zlib.crc32(rows[row].tobytes(), checksum)
    return checksum
