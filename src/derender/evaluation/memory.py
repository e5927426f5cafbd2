"""Remembers what took long, by the content of what it was made from.

A file is named after a hash of the arrays and settings that made it, so it never has to be thrown away: other
features or settings are another file. A table that was interrupted goes on where it stopped.
"""

import hashlib
import json
import struct
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from derender.storage.atomic import atomic_file

Arrays = dict[str, np.ndarray]
NAMES = "names of all arrays"
"""Stands beside the arrays in a file: one that a damaged directory of the zip hides is missed."""

_DAMAGED = (
    *(OSError, ValueError, EOFError, LookupError, RuntimeError),
    *(zipfile.BadZipFile, zlib.error, struct.error),
)


class Memory:
    """Results kept in a folder; without a folder everything is computed.

    Attributes:
        folder: where the files lie, or None.
        recalled, made: how many results were found and how many had to be computed.
    """

    def __init__(self, folder: str | Path | None = None):
        self.folder = None if folder is None else Path(folder)
        self.recalled = self.made = 0

    def recall(self, what: str, inputs: Mapping[str, Any], make: Callable[[], Arrays]) -> Arrays:
        """The arrays that ``make`` gives, from the folder if the very same inputs made them before.

        Args:
            what: the kind of result; begins the file's name. Name it anew when its definition changes.
            inputs: everything that decides the result: arrays, and settings that JSON can hold.
            make: computes it.
        """
        if self.folder is None:
            self.made += 1
            return make()
        file = self.folder / f"{what}-{content_hash(inputs)[:24]}.npz"
        found = _read(file)
        if found is not None:
            self.recalled += 1
            return found
        arrays = make()
        with atomic_file(file) as temporary, temporary.open("wb") as stream:
            np.savez(stream, **arrays, **{NAMES: np.array(list(arrays))})  # pyright: ignore[reportArgumentType]
        self.made += 1
        return arrays


def content_hash(inputs: Mapping[str, Any]) -> str:
    """Hexadecimal digits that change with any value, its kind, its shape or its name."""
    digest = hashlib.sha256()
    for name, value in sorted(inputs.items()):
        if isinstance(value, np.ndarray) and value.dtype.kind != "O":
            array = np.ascontiguousarray(value)
            digest.update(f"{name} {array.dtype.str} {array.shape}\0".encode())
            digest.update(array.view(np.uint8).reshape(-1).data if array.size else b"")
        else:
            plain = value.tolist() if isinstance(value, np.ndarray) else value
            digest.update(f"{name} {json.dumps(plain, sort_keys=True)}\0".encode())
    return digest.hexdigest()


def _read(file: Path) -> Arrays | None:
    """The arrays of a file; None if there is none or it is damaged (it is made again then)."""
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        if not all(isinstance(values, np.ndarray) for values in arrays.values()):
            return None
        names = arrays.pop(NAMES).tolist() if NAMES in arrays else list(arrays)
        return arrays if arrays and sorted(names) == sorted(arrays) else None
    except _DAMAGED:
        return None
