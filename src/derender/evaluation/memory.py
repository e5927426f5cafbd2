"""Results that took long, cached in a folder by the content of their inputs.

A file is named after a hash of the arrays and settings that decide the result, so no entry is ever outdated:
other features or settings are another file. An interrupted table goes on where it stopped. Files are ``.npz``
without objects, so reading one runs no code (joblib.Memory reads pickles).
"""

import dataclasses
import hashlib
import json
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

import numpy as np

from derender.data import cache_folder
from derender.storage.atomic import DamageNoticed, atomic_file

T = TypeVar("T")
Arrays = dict[str, np.ndarray]
NAMES = "names of all arrays"
"""Stands beside the arrays in a file: one that a damaged directory of the zip hides is missed."""

_DAMAGED = (
    *(OSError, ValueError, EOFError, LookupError, RuntimeError),
    *(zipfile.BadZipFile, zlib.error, struct.error),
)


class Memory:
    """Cached results in a folder; without a folder everything is computed.

    Attributes:
        folder: where the files lie, or None.
        recalled, made: how many results came from the cache and how many were computed.
    """

    def __init__(self, folder: str | Path | None = None):
        self.folder = None if folder is None else Path(folder)
        self.recalled = self.made = 0

    def recall(self, what: str, inputs: Mapping[str, Any], make: Callable[[], Arrays]) -> Arrays:
        """The arrays that ``make`` gives, from the folder if the very same inputs made them before.

        A damaged entry is computed again, with a ``DamageNoticed`` warning.

        Args:
            what: the kind of result; begins the file's name. Name it anew when its definition changes.
            inputs: everything that decides the result: arrays, and settings that JSON can hold.
            make: computes it.
        """
        if self.folder is None:
            self.made += 1
            return make()
        file = self.folder / f"{what}-{content_hash(inputs)[:24]}.npz"
        if file.exists():
            cached = _read(file)
            if cached is not None:
                self.recalled += 1
                return cached
            warnings.warn(DamageNoticed(f"{file} is damaged: computed again"), stacklevel=2)
        arrays = make()
        with atomic_file(file) as temporary, temporary.open("wb") as stream:
            np.savez(stream, **arrays, **{NAMES: np.array(list(arrays))})  # pyright: ignore[reportArgumentType]
        self.made += 1
        return arrays

    def recall_value(self, what: str, inputs: Mapping[str, Any], kind: type[T], make: Callable[[], T]) -> T:
        """The same for a dataclass ``kind`` of numbers, texts, arrays, tuples, mappings and such dataclasses.

        An entry of a class whose fields have changed since is another result.
        """
        names = [field.name for field in dataclasses.fields(kind)]  # pyright: ignore[reportArgumentType]
        return unpacked(kind, self.recall(what, {**inputs, "fields": names}, lambda: packed(make())))

    def summary(self, what: str = "results") -> str:
        """One sentence on how many results were computed and how many were cached."""
        folder = "" if self.folder is None else f" in {self.folder}"
        return f"{self.made} {what} computed, {self.recalled} found{folder}"


def memory_in(cache: Memory | str | Path | None) -> Memory:
    """A memory in a folder; for None in the user's cache folder, for "none" without a folder."""
    if isinstance(cache, Memory):
        return cache
    if cache is None:
        return Memory(cache_folder() / "scores")
    return Memory(None if str(cache).lower() == "none" else cache)


def content_hash(inputs: Mapping[str, Any]) -> str:
    """A hash of arrays (bytes, shape, type) and settings by name; the order of names does not matter."""
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


def packed(value: Any) -> Arrays:
    """A dataclass as arrays by name; the array ``value`` holds all other fields as one line of JSON."""
    arrays: Arrays = {}
    fields = _without_arrays(value, "", arrays)
    return {"value": np.array(json.dumps(fields, default=lambda number: number.item())), **arrays}


def unpacked(kind: type[T], arrays: Mapping[str, np.ndarray]) -> T:
    """The inverse of ``packed``; the annotations of ``kind`` say which dataclasses are inside."""
    return _built(kind, json.loads(str(arrays["value"])), arrays)


def _without_arrays(value: Any, path: str, arrays: Arrays) -> Any:
    """A value as JSON takes it; its arrays go into ``arrays`` under their path, which replaces them."""
    if isinstance(value, np.ndarray):
        arrays[path] = value
        return {"array": path}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {name: _without_arrays(one, f"{path}.{name}", arrays) for name, one in value.items()}
    if isinstance(value, tuple | list):
        return [_without_arrays(one, f"{path}.{place}", arrays) for place, one in enumerate(value)]
    return value


def _built(kind: Any, value: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    if isinstance(value, dict) and set(value) == {"array"}:
        return arrays[value["array"]]
    if value is None:
        return None
    classes = [
        one for one in (kind, *get_args(kind)) if isinstance(one, type) and dataclasses.is_dataclass(one)
    ]
    if classes:
        hints = get_type_hints(classes[0])
        return classes[0](**{name: _built(hints[name], one, arrays) for name, one in value.items()})
    return tuple(value) if isinstance(value, list) else value


def _read(file: Path) -> Arrays | None:
    """The arrays of a file; None if it is damaged."""
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        if not all(isinstance(values, np.ndarray) for values in arrays.values()):
            return None
        names = arrays.pop(NAMES).tolist() if NAMES in arrays else list(arrays)
        return arrays if arrays and sorted(names) == sorted(arrays) else None
    except _DAMAGED:
        return None
