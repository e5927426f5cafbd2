"""What a very large folder or zip holds, remembered in the cache folder between starts.

The file is a checksum and, behind it, an archive of numpy arrays: names, numbers and a note. It can be made
again, so one that is missing, damaged or of another version is as good as none, and a full disk is no error.
"""

import hashlib
import io
import json
import os
import sys
from abc import abstractmethod
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64

import derender
from derender.data.names import printable
from derender.data.source import Skipped, Source
from derender.storage.atomic import atomic_file

REMEMBERED_FROM = 50_000
"""Folders and zips with this many files or more are remembered."""

_DAMAGED = (OSError, ValueError, LookupError, TypeError, AttributeError)
_DIGEST_BYTES = 32


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


@dataclass(frozen=True)
class Listing:
    """Files, and what is known of them.

    Attributes:
        files: their names as the system or archive has them, sorted by their printable form.
        numbers: (N, k) whole numbers, a row for each file; (N, 0) before they are looked up.
        faults: what is no usable file: its name, and why.
        proof: what must still be so for the listing to hold.
        layout: the layout that was recognised, "" for none.
    """

    files: tuple[str, ...]
    numbers: Int64[np.ndarray, "n k"]
    faults: tuple[tuple[str, str], ...]
    proof: dict[str, Any] = field(default_factory=dict)
    layout: str = ""

    def write(self, file: Path) -> None:
        """Write the listing to a file; one that cannot be written is only slower next time."""
        note = {"version": derender.__version__, "proof": self.proof}
        note |= {"faults": self.faults, "layout": self.layout}
        names = "\0".join(self.files).encode("utf-8", "surrogateescape")
        texts = {"note": json.dumps(note).encode(), "names": names}
        buffer = io.BytesIO()
        arrays = {name: np.frombuffer(text, np.uint8) for name, text in texts.items()}
        np.savez(buffer, numbers=self.numbers, **arrays)  # pyright: ignore[reportArgumentType]
        content = buffer.getbuffer()
        try:
            with atomic_file(file) as temporary, temporary.open("wb") as stream:
                stream.write(_checksum(content))
                stream.write(content)
        except OSError:
            return


def read_listing(file: Path) -> Listing | None:
    """What was written, or None where there is none, it is damaged, or another version wrote it."""
    try:
        with file.open("rb") as stream:
            checksum, content = stream.read(_DIGEST_BYTES), stream.read()
        if _checksum(content) != checksum:
            return None
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            note = json.loads(arrays["note"].tobytes())
            joined = arrays["names"].tobytes().decode("utf-8", "surrogateescape")
            numbers = arrays["numbers"]
        names, faults = tuple(joined.split("\0")), tuple((name, why) for name, why in note["faults"])
        if note["version"] != derender.__version__ or len(numbers) != len(names):
            return None
        return Listing(names, numbers, faults, note["proof"], note["layout"])
    except _DAMAGED:
        return None


def _checksum(content: bytes | memoryview) -> bytes:
    return hashlib.blake2b(content, digest_size=_DIGEST_BYTES).digest()


class ListedSource(Source):
    """A source whose files are listed, by itself or by what was remembered of it."""

    def __init__(self, path: Path):
        self.path = path
        whole = path.resolve()
        key = hashlib.sha256(str(whole).encode("utf-8", "surrogateescape")).hexdigest()
        self._file = cache_folder() / f"{whole.name[:40]}-{key[:16]}.listing"
        known = read_listing(self._file)
        self._remembered = known is not None and self._holds(known)
        self.listing = known if known is not None and self._remembered else self._listed()
        self.recognised = self.listing.layout
        self.files = tuple(map(printable, self.listing.files))
        faults = [Skipped(printable(file), reason) for file, reason in self.listing.faults]
        self.skipped = tuple(sorted(faults, key=lambda row: row.file))

    @abstractmethod
    def _listed(self) -> Listing:
        """List the files anew."""

    @abstractmethod
    def _holds(self, known: Listing) -> bool:
        """Whether a remembered listing still tells what is there."""

    @cached_property
    def numbers(self) -> Int64[np.ndarray, "n k"]:
        """A row for every file."""
        return self.listing.numbers

    def remember(self) -> None:
        if len(self.files) < REMEMBERED_FROM:
            return
        if not self._remembered or self.listing.layout != self.recognised:
            self.listing = replace(self.listing, numbers=self.numbers, layout=self.recognised)
            self.listing.write(self._file)
            self._remembered = True

    def row_of(self, file: str) -> int:
        """The place of a file in ``files``."""
        row = bisect_left(self.files, file)
        if row == len(self.files) or self.files[row] != file:
            raise ValueError(f"{file} is not in {self.path}")
        return row

    def rows_of(self, files: Sequence[str]) -> list[int] | slice:
        """The places of files in ``files``."""
        return slice(None) if files == self.files else [self.row_of(file) for file in files]
