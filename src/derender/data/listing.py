"""The files below a folder: found by one walk, and remembered where there are very many.

What is remembered (names, sizes, times of change, the layout that was recognised) counts only while every
folder has the time of change it had, which any file added, removed or renamed alters, every file that is no
picture is as it was, and so is a sample of a thousand files. A few of very many pictures that are written
over in place, under their old names, therefore go unnoticed; below ``REMEMBERED_FROM`` files nothing is
remembered and every file is looked at. Listings lie in the cache folder; deleting one there does no harm.
"""

import os
import stat
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from derender.data.kept import Kept, keep, read_kept

REMEMBERED_FROM = 50_000
"""Folders with this many files or more are remembered."""

SAMPLED = 1_000
_SETTLED_NS = 2_000_000_000  # what changed a moment ago may change again within one tick of the disk's clock


@dataclass(frozen=True)
class Listing:
    """What lies below a folder.

    Attributes:
        files: every regular file that is not hidden, as a path relative to the folder, in the order met.
        faults: what is no regular file or cannot be looked at: its path, and why.
        folders: every folder ("" is the root itself) with its time of change in nanoseconds.
    """

    files: tuple[str, ...]
    faults: tuple[tuple[str, str], ...]
    folders: tuple[tuple[str, int], ...]

    def in_order(self, key: Callable[[str], str]) -> "Listing":
        """The same with the files sorted by what ``key`` makes of them."""
        return Listing(tuple(sorted(self.files, key=key)), self.faults, self.folders)


@dataclass(frozen=True)
class Remembered:
    """A listing that was found to hold still.

    Attributes:
        listing: the files.
        stamps: (N, 2) size and time of change in nanoseconds of each file.
        layout: the layout that was recognised, or "".
    """

    listing: Listing
    stamps: Int64[np.ndarray, "n 2"]
    layout: str


def list_files(root: str, hidden: Callable[[str], bool]) -> Listing:
    """Walk a folder. Links are followed, each real folder once, so that loops end.

    Args:
        root: where to begin.
        hidden: whether a file or folder of this name is passed over.
    """
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
            if hidden(entry.name):
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
    return Listing(tuple(files), tuple(faults), tuple(folders))


def stamps_of(root: str, files: tuple[str, ...]) -> Int64[np.ndarray, "n 2"]:
    """Size and time of change in nanoseconds of each file; a file that has gone has -1."""
    stamps = np.empty((len(files), 2), np.int64)
    for row, file in enumerate(files):
        stamps[row] = _stamp(f"{root}/{file}")
    return stamps


def remember(file: Path, listing: Listing, stamps: Int64[np.ndarray, "n 2"], layout: str) -> None:
    """Keep a listing; that nothing can be kept is no error."""
    note = {
        "made_ns": time.time_ns(),
        "folders": listing.folders,
        "faults": listing.faults,
        "layout": layout,
    }
    keep(file, Kept(listing.files, stamps, note))


def recall(file: Path, root: str, is_picture: Callable[[str], bool]) -> Remembered | None:
    """The listing that is kept, if the folder still is as it says, else None."""
    kept = read_kept(file)
    if kept is None or "folders" not in kept.note:
        return None
    files, stamps, note = kept.names, kept.array, kept.note
    listing = Listing(
        files,
        tuple((path, why) for path, why in note["faults"]),
        tuple((path, changed) for path, changed in note["folders"]),
    )
    settled = note["made_ns"] - _SETTLED_NS
    for path, changed in listing.folders:
        if changed > settled or _stamp(f"{root}/{path}")[1] != changed:
            return None
    checked = {row for row, path in enumerate(files) if not is_picture(path)}
    checked |= set(np.linspace(0, len(files) - 1, SAMPLED).astype(int).tolist())
    if any(_stamp(f"{root}/{files[row]}") != tuple(stamps[row].tolist()) for row in checked):
        return None
    return Remembered(listing, stamps, note["layout"])


def _stamp(path: str) -> tuple[int, int]:
    try:
        status = os.stat(path)  # noqa: PTH116
    except OSError:
        return -1, -1
    return status.st_size, status.st_mtime_ns
