"""Names, arrays and a note in one file of the cache folder: whole or not at all, checked when read back.

The file is a checksum and, behind it, an archive of numpy arrays. Such a file can be made again, so one that
is missing, damaged or of another version is as good as none, and a disk that is full is no error.
"""

import hashlib
import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import derender
from derender.storage.atomic import atomic_file

_DAMAGED = (OSError, ValueError, LookupError, TypeError, AttributeError)


@dataclass(frozen=True)
class Kept:
    """What a file holds.

    Attributes:
        names: file names; none has a zero byte.
        array: numbers, a row for each name.
        note: anything JSON can hold.
    """

    names: tuple[str, ...]
    array: np.ndarray
    note: dict[str, Any]


def kept_file(cache: Path, path: Path, suffix: str) -> Path:
    """Where something about a folder or file is kept in the cache folder."""
    whole = path.resolve()
    key = hashlib.sha256(str(whole).encode("utf-8", "surrogateescape")).hexdigest()
    return cache / f"{whole.name[:40]}-{key[:16]}.{suffix}"


def keep(file: Path, kept: Kept) -> None:
    """Write the file. What is not kept is only slower next time, so nothing is raised."""
    note = json.dumps({**kept.note, "version": derender.__version__}).encode()
    names = "\0".join(kept.names).encode("utf-8", "surrogateescape")
    buffer = io.BytesIO()
    np.savez(
        buffer, note=np.frombuffer(note, np.uint8), names=np.frombuffer(names, np.uint8), array=kept.array
    )
    content = buffer.getbuffer()
    try:
        with atomic_file(file) as temporary, temporary.open("wb") as stream:
            stream.write(_checksum(content))
            stream.write(content)
    except OSError:
        return


def read_kept(file: Path) -> Kept | None:
    """What was kept, or None where there is none, it is damaged, or another version wrote it."""
    try:
        with file.open("rb") as stream:
            checksum, content = stream.read(32), stream.read()
        if _checksum(content) != checksum:
            return None
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            note = json.loads(arrays["note"].tobytes())
            joined = arrays["names"].tobytes().decode("utf-8", "surrogateescape")
            array = arrays["array"]
        names = tuple(joined.split("\0"))
        if note["version"] != derender.__version__ or len(array) != len(names):
            return None
    except _DAMAGED:
        return None
    return Kept(names, array, note)


def _checksum(content: bytes | memoryview) -> bytes:
    return hashlib.blake2b(content, digest_size=32).digest()
