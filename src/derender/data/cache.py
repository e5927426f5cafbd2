"""Decoded images of a large data set in one file that is mapped into memory.

The file is the rows themselves, appended as they are decoded, then a JSON note (what they were made from,
which files they are, labels that came with them), then the note's length and a mark. It is written under
another name and moved into place when complete, so a reader never sees half of one. It counts only if the
note's fingerprint is that of the source as it is now, its length is right, and a sample of its rows has the
recorded checksum; otherwise it is made again. One file per source and setting: a new version takes the old
one's place.
"""

import hashlib
import json
import os
import tempfile
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from jaxtyping import UInt8

_MARK = b"derender pictures 2\n"
_SAMPLED_ROWS = 64
_ABANDONED_SECONDS = 86_400


def cache_file(folder: Path, name: str, key: tuple[object, ...]) -> Path:
    """Where rows are cached: a source's name for people, and everything that tells it from others."""
    digest = hashlib.sha256(repr(key).encode("utf-8", "backslashreplace")).hexdigest()
    return folder / f"{name[:40]}-{digest[:16]}.pictures"


def read_cache(
    file: Path, fingerprint: str, image_size: int
) -> tuple[UInt8[np.ndarray, "n 3 s s"], dict[str, Any]] | None:
    """The rows and the note, or None if there are none or they were made of something else.

    The rows are a private memory map: writing to them changes no file.
    """
    try:
        with file.open("rb") as stream:
            end = stream.seek(-len(_MARK) - 8, os.SEEK_END)
            length = int.from_bytes(stream.read(8), "little")
            if stream.read() != _MARK or length > end:
                return None
            stream.seek(end - length)
            note = json.loads(stream.read(length))
        found, checksum, content = note["fingerprint"], note["checksum"], note["content"]
        count = len(content["files"])
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return None
    if found != fingerprint or end - length != count * 3 * image_size * image_size or not count:
        return None
    images = np.memmap(file, np.uint8, mode="c", shape=(count, 3, image_size, image_size))
    return (images, content) if sample_checksum(images) == checksum else None


class CacheWriter:
    """Rows being appended to a draft; ``finish`` puts it in place."""

    def __init__(self, file: Path, stream: IO[bytes], image_size: int):
        self._file = file
        self._stream = stream
        self._size = image_size

    def append(self, rows: UInt8[np.ndarray, "n 3 s s"]) -> None:
        """Write some rows behind those that are there."""
        try:
            self._stream.write(np.ascontiguousarray(rows).data)
        except OSError as problem:
            raise _no_room(self._file, self._stream.tell(), problem) from problem

    def finish(self, fingerprint: str, content: dict[str, Any]) -> None:
        """Append the note and move the file into place; ``content["files"]`` names the rows."""
        try:
            self._stream.flush()
            shape = (len(content["files"]), 3, self._size, self._size)
            rows = np.memmap(self._stream.name, np.uint8, mode="r", shape=shape)
            note = {"fingerprint": fingerprint, "checksum": sample_checksum(rows), "content": content}
            encoded = json.dumps(note).encode()
            self._stream.write(encoded + len(encoded).to_bytes(8, "little") + _MARK)
            self._stream.flush()
            os.fsync(self._stream.fileno())
            Path(self._stream.name).replace(self._file)
        except OSError as problem:
            raise _no_room(self._file, self._stream.tell(), problem) from problem


@contextmanager
def new_cache(file: Path, image_size: int) -> Iterator[CacheWriter]:
    """A draft beside ``file`` that rows are appended to; what is not finished is deleted."""
    draft = None
    try:
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            for other in file.parent.glob(f".{file.name}.*"):  # of a process that was killed
                if other.stat().st_mtime < time.time() - _ABANDONED_SECONDS:
                    other.unlink(missing_ok=True)
            handle, name = tempfile.mkstemp(prefix=f".{file.name}.", dir=file.parent)
            draft = Path(name)
            os.close(handle)
        except OSError as problem:
            raise _no_room(file, 0, problem) from problem
        with draft.open("ab") as stream:
            yield CacheWriter(file, stream, image_size)
    finally:
        if draft is not None:
            draft.unlink(missing_ok=True)


def _no_room(file: Path, needed: int, problem: OSError) -> OSError:
    return OSError(
        f"cannot keep {needed / 1e9:.3g} GB of decoded images in {file.parent} "
        f"({problem.strerror or problem}); "
        "set DERENDER_CACHE to a folder on another disk, or ask for smaller images"
    )


def sample_checksum(rows: np.ndarray) -> int:
    """CRC of at most 64 rows, evenly spaced, the first and the last among them."""
    chosen = np.unique(np.linspace(0, len(rows) - 1, _SAMPLED_ROWS).astype(int)) if len(rows) else []
    checksum = 0
    for row in chosen:
        checksum = zlib.crc32(rows[row].tobytes(), checksum)
    return checksum
