"""Every file below a folder, found by one walk.

Hidden files and ``__MACOSX`` are left out. Links are followed, each real folder once, so that loops end.

The remembered listing of a very large folder holds while every folder has the time of change it had, which
any file added, removed or renamed alters, every file that is no image is as it was, and so is a sample of a
thousand files. A few of very many images that are written over in place therefore go unnoticed; below
``REMEMBERED_FROM`` files nothing is remembered and every file is looked at.
"""

import os
import stat
import time
from collections.abc import Sequence
from functools import cached_property

import numpy as np
from jaxtyping import Int64

from derender.data import listing
from derender.data.listing import ListedSource, Listing
from derender.data.names import is_hidden, is_image, printable
from derender.data.source import read_bounded

SAMPLED = 1_000
_SETTLED_NS = 2_000_000_000  # what changed a moment ago may change again within one tick of the disk's clock


class FolderSource(ListedSource):
    """Every file below a folder; ``numbers`` are size and time of change in nanoseconds of each."""

    def read(self, file: str) -> bytes:
        return read_bounded(self.path / self._real.get(file, file))

    def stamps(self, files: Sequence[str]) -> Int64[np.ndarray, "n 2"]:
        if len(self.files) >= listing.REMEMBERED_FROM:
            return self.numbers[self.rows_of(files)]
        found = [_stamp(f"{self.path}/{self._real.get(file, file)}") for file in files]
        return np.array(found, np.int64).reshape(-1, 2)

    @cached_property
    def numbers(self) -> Int64[np.ndarray, "n 2"]:
        if self.listing.numbers.shape[1]:
            return self.listing.numbers
        stamps = np.empty((len(self.files), 2), np.int64)
        for row, file in enumerate(self.listing.files):
            stamps[row] = _stamp(f"{self.path}/{file}")
        return stamps

    @cached_property
    def _real(self) -> dict[str, str]:
        """The names that are not as they are printed."""
        pairs = zip(self.files, self.listing.files, strict=True)
        return {name: file for name, file in pairs if name is not file}

    def _listed(self) -> Listing:
        return list_files(str(self.path))

    def _holds(self, known: Listing) -> bool:
        files, stamps, root = known.files, known.numbers, str(self.path)
        if "folders" not in known.proof or stamps.shape[1] != 2:
            return False
        settled = known.proof["made_ns"] - _SETTLED_NS
        for path, changed in known.proof["folders"]:
            if changed > settled or _stamp(f"{root}/{path}")[1] != changed:
                return False
        checked = {row for row, path in enumerate(files) if not is_image(path)}
        checked |= set(np.linspace(0, len(files) - 1, SAMPLED).astype(int).tolist())
        return all(_stamp(f"{root}/{files[row]}") == tuple(stamps[row].tolist()) for row in checked)


def list_files(root: str) -> Listing:
    """Walk a folder. The proof has every folder with its time of change ("" is the root itself)."""
    files: list[str] = []
    faults: list[tuple[str, str]] = []
    folders: list[tuple[str, int]] = []
    seen: set[tuple[int, int]] = set()
    waiting = [""]
    while waiting:
        here = waiting.pop()
        try:
            status = os.stat(f"{root}/{here}")  # noqa: PTH116  (a million times; so below)
            if (status.st_dev, status.st_ino) in seen:
                continue
            seen.add((status.st_dev, status.st_ino))
            with os.scandir(f"{root}/{here}") as found:
                entries = list(found)
        except OSError as problem:
            faults.append((here.rstrip("/") or ".", f"folder cannot be listed: {problem.strerror}"))
            continue
        folders.append((here, status.st_mtime_ns))
        below: list[str] = []
        for entry in entries:
            if is_hidden(entry.name):
                continue
            path = f"{here}{entry.name}"
            try:
                if entry.is_file():
                    files.append(path)
                elif entry.is_dir():
                    below.append(f"{path}/")
                elif stat.S_ISREG(entry.stat().st_mode):  # a broken link raises here
                    files.append(path)
                else:
                    faults.append((path, "not a regular file"))
            except OSError as problem:
                faults.append((path, f"broken link or unreachable file: {problem.strerror}"))
        waiting += sorted(below, reverse=True)
    files.sort(key=printable)
    proof = {"made_ns": time.time_ns(), "folders": folders}
    return Listing(tuple(files), np.empty((len(files), 0), np.int64), tuple(faults), proof)


def _stamp(path: str) -> tuple[int, int]:
    """Size and time of change in nanoseconds; a file that has gone has -1."""
    try:
        status = os.stat(path)  # noqa: PTH116
    except OSError:
        return -1, -1
    return status.st_size, status.st_mtime_ns
