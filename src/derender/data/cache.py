"""Decoded images of a large data set in one file that is mapped into memory; the folder of such files.

The file is the rows, then a JSON note, its length and a mark. The note has what the rows were made from,
which files they are, and labels that came with them. It counts only if the fingerprint is that of the source
now, the length is right, and a sample of rows has the recorded checksum. Otherwise it is made again. One file
per source and setting: a new version takes the old one's place.
"""

import json
import os
import sys
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from derender.data.source import evenly_spaced
from derender.storage.atomic import atomic_file

_MARK = b"derender pictures 2\n"
_ABANDONED_SECONDS = 86_400


def cache_folder() -> Path:
    """``$DERENDER_CACHE``, or derender's folder in the place this system has for caches."""
    if "DERENDER_CACHE" in os.environ:
        return Path(os.environ["DERENDER_CACHE"])
    if sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    elif sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    return base / "derender"


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
        checksum, content = note["checksum"], note["content"]
        count = len(content["files"])
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return None
    if note.get("fingerprint") != fingerprint or not end - length == count * 3 * image_size**2 > 0:
        return None
    images = np.memmap(file, np.uint8, mode="c", shape=(count, 3, image_size, image_size))
    return (images, content) if sample_checksum(images) == checksum else None


def write_cache(
    file: Path, fingerprint: str, image_size: int, chunks: Iterator[np.ndarray],
    known: Callable[[], dict[str, Any]],
) -> None:  # fmt: skip
    """Make the file anew of rows in ``chunks``, (n, 3, S, S) uint8; an OSError says what to do.

    ``known`` gives, after the last, what is known of the rows; its "files" name them.
    """
    written, storing = 0, True
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        for other in file.parent.glob(f".{file.name}-*"):  # of a process that was killed
            if other.stat().st_mtime < time.time() - _ABANDONED_SECONDS:
                other.unlink(missing_ok=True)
        with atomic_file(file, durable=True) as draft, draft.open("wb") as stream:
            storing = False
            for rows in chunks:
                storing = True
                stream.write(np.ascontiguousarray(rows).data)
                written, storing = written + rows.nbytes, False
            storing = True
            stream.flush()
            shape = (len((content := known())["files"]), 3, image_size, image_size)
            checksum = sample_checksum(np.memmap(draft, np.uint8, mode="r", shape=shape))
            note = {"fingerprint": fingerprint, "checksum": checksum, "content": content}
            encoded = json.dumps(note).encode()
            stream.write(encoded + len(encoded).to_bytes(8, "little") + _MARK)
    except OSError as problem:
        if not storing:  # the images could not be read
            raise
        raise OSError(
            f"cannot keep {written / 1e9:.3g} GB of decoded images in {file.parent} "
            f"({problem.strerror or problem}); "
            "set DERENDER_CACHE to a folder on another disk, or ask for smaller images"
        ) from problem


def sample_checksum(rows: np.ndarray) -> int:
    """CRC of at most 64 rows."""
    return zlib.crc32(rows[evenly_spaced(len(rows), 64)].tobytes())
