"""Results that took long, cached in a folder by the content of their inputs.

A file is named after a hash of the arrays and settings that decide the result, so no entry is ever outdated.
An interrupted table continues where it stopped. Files are ``.npz`` without objects, so reading one runs no
code (joblib.Memory reads pickles).
"""

import dataclasses
import hashlib
import json
import struct
import warnings
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar
from zipfile import BadZipFile

import numpy as np
from pydantic import ConfigDict, TypeAdapter

from derender.data import cache_folder
from derender.storage.atomic import DamageNoticed, atomic_file

T = TypeVar("T")
Arrays = dict[str, np.ndarray]
NAMES = "names of all arrays"  # stand beside them: one that a damaged directory of the zip hides is missed
_DAMAGED = (OSError, ValueError, EOFError, LookupError, RuntimeError, BadZipFile, zlib.error, struct.error)


class Memory:
    """Cached results in a folder, or None to compute everything; counts of those found and those computed."""

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
        file = None if self.folder is None else self.folder / f"{what}-{content_hash(inputs)[:24]}.npz"
        if file is not None and file.exists():
            if (cached := _read(file)) is not None:
                self.recalled += 1
                return cached
            warnings.warn(DamageNoticed(f"{file} is damaged: computed again"), stacklevel=2)
        arrays = make()
        if file is not None:
            with atomic_file(file) as temporary, temporary.open("wb") as stream:
                np.savez(stream, **arrays, **{NAMES: np.array(list(arrays))})  # pyrefly: ignore[bad-argument-type]
        self.made += 1
        return arrays

    def recall_one(self, what: str, inputs: Mapping[str, Any], make: Callable[[], np.ndarray]) -> np.ndarray:
        """The same for a single array."""
        (result,) = self.recall(what, inputs, lambda: {"value": make()}).values()
        return result

    def recall_value(self, what: str, inputs: Mapping[str, Any], kind: type[T], make: Callable[[], T]) -> T:
        """The same for a dataclass ``kind`` of numbers, texts, arrays, tuples, mappings and such dataclasses.

        An entry of a class whose fields have changed since is another result.
        """
        names = [field.name for field in dataclasses.fields(kind)]  # pyrefly: ignore[bad-argument-type]
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

    def plain(one: Any) -> Any:
        if not isinstance(one, np.ndarray):
            return one.item()
        arrays[name := f"array {len(arrays)}"] = one
        return {"array": name}

    return {"value": np.array(json.dumps(dataclasses.asdict(value), default=plain)), **arrays}


def unpacked(kind: type[T], arrays: Mapping[str, np.ndarray]) -> T:
    """The inverse of ``packed``; the annotations of ``kind`` say which dataclasses are inside."""

    def whole(one: dict[str, Any]) -> Any:
        return arrays[one["array"]] if set(one) == {"array"} else one

    holder: Any = tuple[kind]
    adapter = TypeAdapter(holder, config=ConfigDict(arbitrary_types_allowed=True))
    return adapter.validate_python([json.loads(str(arrays["value"]), object_hook=whole)])[0]


def _read(file: Path) -> Arrays | None:
    """The arrays of a file; None if it is damaged."""
    try:
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        if not all(isinstance(values, np.ndarray) for values in arrays.values()):
            return None
        names = arrays.pop(NAMES, np.array(list(arrays))).tolist()
        return arrays if arrays and sorted(names) == sorted(arrays) else None
    except _DAMAGED:
        return None
