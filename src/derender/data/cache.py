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
    home = Path.home()
    windows = os.environ.get("LOCALAPPDATA", home / "AppData" / "Local")
    places = {"darwin": home / "Library" / "Caches", "win32": Path(windows)}
    return places.get(sys.platform, Path(os.environ.get("XDG_CACHE_HOME", home / ".cache"))) / "derender"


def read_cache(
    file: Path, fingerprint: str, image_size: int
) -> tuple[UInt8[np.ndarray, "n 3 s s"], dict[str, Any]] | None:
    """Rows, in memory that can be written and changes no file, and note; None: none, or of something else."""
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
            checksum = sample_checksum(np.memmap(draft, mode="r").reshape(-1, 3, image_size, image_size))
            note = {"fingerprint": fingerprint, "checksum": checksum, "content": known()}
            encoded = json.dumps(note).encode()
            stream.write(encoded + len(encoded).to_bytes(8, "little") + _MARK)
    except OSError as problem:
        if not storing:  # the images could not be read
            raise
        what = f"cannot keep {written / 1e9:.3g} GB of decoded images in {file.parent}"
        fix = "set DERENDER_CACHE to a folder on another disk, or ask for smaller images"
        raise OSError(f"{what} ({problem.strerror or problem}); {fix}") from problem


def sample_checksum(rows: np.ndarray) -> int:
    """CRC of at most 64 rows."""
    return zlib.crc32(rows[evenly_spaced(len(rows), 64)].tobytes())
