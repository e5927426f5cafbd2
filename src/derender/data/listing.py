"""What a very large folder or zip holds, remembered in the cache folder between starts.

The file is a checksum and, behind it, an archive of numpy arrays: numbers, a note and names. It can be made
again, so one that is missing, damaged or of another version is as good as none, and a full disk is no error.
"""

import hashlib
import io
import json
from abc import abstractmethod
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64

import derender
from derender.data.cache import cache_folder
from derender.data.source import Skipped, Source, printable
from derender.storage.atomic import atomic_file

REMEMBERED_FROM = 50_000  # folders and zips with this many files or more are remembered
_DIGEST_BYTES = 32


@dataclass(frozen=True)
class Listing:
    """Files, and what is known of them."""

    files: tuple[str, ...]  # their names as the system or archive has them, sorted by their shown form
    numbers: Int64[np.ndarray, "n k"]  # a row of whole numbers for each file
    faults: Sequence[Sequence[str]]  # names of what is no usable file, and why
    proof: Mapping[str, Any]  # what must still be so for the listing to hold
    layout: str = ""  # the layout that was recognised, "" for none

    def write(self, file: Path) -> None:
        """Write the listing to a file; one that cannot be written is only slower next time."""
        facts = {"faults": self.faults, "proof": self.proof, "layout": self.layout}
        texts = json.dumps({"version": derender.__version__, **facts}), "\0".join(self.files)
        as_bytes = [np.frombuffer(text.encode("utf-8", "surrogateescape"), np.uint8) for text in texts]
        buffer = io.BytesIO()
        np.savez(buffer, self.numbers, *as_bytes)
        with suppress(OSError), atomic_file(file) as temporary, temporary.open("wb") as stream:
            stream.write(_checksum(buffer.getbuffer()))
            stream.write(buffer.getbuffer())


def read_listing(file: Path) -> Listing | None:
    """What was written, or None where there is none, it is damaged, or another version wrote it."""
    try:
        content = memoryview(file.read_bytes())
        if _checksum(content[_DIGEST_BYTES:]) != content[:_DIGEST_BYTES]:
            return None
        with np.load(io.BytesIO(content[_DIGEST_BYTES:]), allow_pickle=False) as arrays:
            numbers, note, names = (arrays[name] for name in arrays.files)
        facts = json.loads(note.tobytes())
        if facts.pop("version") != derender.__version__:
            return None
        return Listing(
            tuple(names.tobytes().decode("utf-8", "surrogateescape").split("\0")), numbers, **facts
        )
    except (OSError, ValueError, LookupError, TypeError):
        return None


def _checksum(content: bytes | memoryview) -> bytes:
    return hashlib.blake2b(content, digest_size=_DIGEST_BYTES).digest()


class ListedSource(Source):
    """A source whose files are listed, by itself or by what was remembered of it.

    Attributes:
        listing: the files, a row of numbers each.
    """

    stamped: tuple[int, int] = (0, 1)  # the two columns of these numbers that change with a file's content

    def __init__(self, path: Path):
        self.path = path
        whole = path.resolve()
        key = hashlib.sha256(str(whole).encode("utf-8", "surrogateescape")).hexdigest()
        self._file = cache_folder() / f"{whole.name[:40]}-{key[:16]}.listing"
        known = read_listing(self._file)
        self._remembered = known is not None and self._holds(known)
        self.listing = known if known is not None and self._remembered else self._listed()
        self.recognised = self.listing.layout
        self.files = tuple(map(self.shown, self.listing.files))
        faults = [Skipped(printable(file), reason) for file, reason in self.listing.faults]
        self.skipped = tuple(sorted(faults, key=lambda row: row.file))

    @abstractmethod
    def _listed(self) -> Listing:
        """List the files anew."""

    @abstractmethod
    def _holds(self, known: Listing) -> bool:
        """Whether a remembered listing still tells what is there."""

    @staticmethod
    def shown(name: str) -> str:
        """How a name is told and stored."""
        return printable(name)

    @cached_property
    def renamed(self) -> dict[str, str]:
        """The files that are not called as they are shown, by shown name."""
        pairs = zip(self.files, self.listing.files, strict=True)
        return {shown: name for shown, name in pairs if shown is not name and shown != name}

    def remember(self) -> None:
        if len(self.files) < REMEMBERED_FROM:
            return
        if not self._remembered or self.listing.layout != self.recognised:
            self.listing = replace(self.listing, layout=self.recognised)
            self.listing.write(self._file)
            self._remembered = True

    def row_of(self, file: str) -> int:
        """The place of a file in ``files``."""
        row = bisect_left(self.files, file)
        if row == len(self.files) or self.files[row] != file:
            raise ValueError(f"{file} is not in {self.path}")
        return row

    def stamps(self, files: Sequence[str]) -> Int64[np.ndarray, "n 2"]:
        rows = slice(None) if files == self.files else [self.row_of(file) for file in files]
        return self.listing.numbers[rows][:, self.stamped]
