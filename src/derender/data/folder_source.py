"""Every file below a folder, found by one walk.

Hidden files and ``__MACOSX`` are left out. Links are followed, each real folder once, so that loops end.
"""

import os
import stat
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from derender.data.source import FILE_LIMIT_BYTES, Skipped, Source, is_hidden, printable
from derender.storage.bounded import read_bounded


class FolderSource(Source):
    """Every file below a folder."""

    def __init__(self, path: Path):
        self.path = path
        self._found, faults = _walk(str(path))
        self.files = tuple(sorted(self._found))
        self.skipped = tuple(sorted(faults, key=lambda row: row.file))

    def on_disk(self, file: str) -> Path:
        """Where a file lies."""
        return self.path / self._found[file][0]

    def read(self, file: str) -> bytes:
        return read_bounded(self.on_disk(file), FILE_LIMIT_BYTES)

    def stamps(self, files: Sequence[str]) -> Int64[np.ndarray, "n 2"]:
        return np.array([self._found[file][1:] for file in files], np.int64).reshape(-1, 2)


def _walk(root: str) -> tuple[dict[str, tuple[str, int, int]], list[Skipped]]:
    """Each file by its printable path: its path, size and time of change in nanoseconds; and what is none."""
    found: dict[str, tuple[str, int, int]] = {}
    faults: list[Skipped] = []
    seen: set[tuple[int, int]] = set()
    waiting = [""]
    while waiting:
        here = waiting.pop()
        try:
            status = os.stat(f"{root}/{here}")  # noqa: PTH116  (a million times)
            if (status.st_dev, status.st_ino) in seen:
                continue
            seen.add((status.st_dev, status.st_ino))
            with os.scandir(f"{root}/{here}") as listed:
                entries = [entry for entry in listed if not is_hidden(entry.name)]
        except OSError as problem:
            name = printable(here.rstrip("/") or ".")
            faults.append(Skipped(name, f"folder cannot be listed: {problem.strerror}"))
            continue
        below: list[str] = []
        for entry in entries:
            path = f"{here}{entry.name}"
            try:
                status = entry.stat()
            except OSError as problem:
                reason = f"broken link or unreachable file: {problem.strerror}"
                faults.append(Skipped(printable(path), reason))
                continue
            if stat.S_ISREG(status.st_mode):
                found[printable(path)] = path, status.st_size, status.st_mtime_ns
            elif stat.S_ISDIR(status.st_mode):
                below.append(f"{path}/")
            else:
                faults.append(Skipped(printable(path), "not a regular file"))
        waiting += sorted(below, reverse=True)
    return found, faults
