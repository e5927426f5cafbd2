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
from array import array

import numpy as np

from derender.data.listing import ListedSource, Listing
from derender.data.source import is_hidden, is_image, printable, read_bounded

SAMPLED = 1_000
_SETTLED_NS = 2_000_000_000  # what changed a moment ago may change again within one tick of the disk's clock


class FolderSource(ListedSource):
    """Every file below a folder; the numbers are size and time of change in nanoseconds."""

    def read(self, file: str) -> bytes:
        return read_bounded(self.path / self.renamed.get(file, file))

    def _listed(self) -> Listing:
        return list_files(str(self.path))

    def _holds(self, known: Listing) -> bool:
        if "folders" not in known.proof:
            return False
        root, settled = str(self.path), known.proof["made_ns"] - _SETTLED_NS
        for path, changed in known.proof["folders"]:
            if changed > settled or _stamp(f"{root}/{path}")[1] != changed:
                return False
        checked = {row for row, path in enumerate(known.files) if not is_image(path)}
        checked |= set(np.linspace(0, len(known.files) - 1, SAMPLED).astype(int).tolist())
        numbers = known.numbers
        return all(_stamp(f"{root}/{known.files[row]}") == tuple(numbers[row].tolist()) for row in checked)


def list_files(root: str) -> Listing:
    """Walk a folder. The proof has every folder with its time of change ("" is the root itself)."""
    files: list[str] = []
    numbers = array("q")
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
                entries = [entry for entry in found if not is_hidden(entry.name)]
        except OSError as problem:
            faults.append((here.rstrip("/") or ".", f"folder cannot be listed: {problem.strerror}"))
            continue
        folders.append((here, status.st_mtime_ns))
        below: list[str] = []
        for entry in entries:
            path = f"{here}{entry.name}"
            try:
                status = entry.stat()
            except OSError as problem:
                faults.append((path, f"broken link or unreachable file: {problem.strerror}"))
                continue
            if stat.S_ISREG(status.st_mode):
                files.append(path)
                numbers.extend((status.st_size, status.st_mtime_ns))
            elif stat.S_ISDIR(status.st_mode):
                below.append(f"{path}/")
            else:
                faults.append((path, "not a regular file"))
        waiting += sorted(below, reverse=True)
    order = sorted(range(len(files)), key=lambda row: printable(files[row]))
    rows = np.frombuffer(numbers, np.int64).reshape(-1, 2)[order]
    proof = {"made_ns": time.time_ns(), "folders": folders}
    return Listing(tuple(files[row] for row in order), rows, faults, proof)


def _stamp(path: str) -> tuple[int, int]:
    """Size and time of change in nanoseconds; a file that has gone has -1."""
    try:
        status = os.stat(path)  # noqa: PTH116
    except OSError:
        return -1, -1
    return status.st_size, status.st_mtime_ns
