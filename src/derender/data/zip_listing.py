"""The members of a zip that count, and those passed over; remembered for archives of very many.

What is remembered counts only while the archive's directory is, byte for byte, the one it was made from: the
directory is read at every start and its BLAKE2 checksum compared, so that no change goes unnoticed. Like the
listings of folders it lies in the cache folder, and deleting it there does no harm.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from derender.data.kept import Kept, keep, read_kept
from derender.data.names import is_hidden
from derender.data.zip_directory import MEMBER, Directory, members_of

_ENCRYPTED = 1


@dataclass(frozen=True)
class ZipListing:
    """What a zip holds.

    Attributes:
        files: the members that are neither hidden, unsafe nor encrypted, with forward slashes, sorted.
        members: (N,) rows of ``MEMBER`` for these files.
        faults: members with unsafe names and encrypted ones: the name, and why.
    """

    files: tuple[str, ...]
    members: np.ndarray
    faults: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class RememberedZip:
    """A listing that was found to hold still, and the layout that was recognised ("" for none)."""

    listing: ZipListing
    layout: str


def list_zip(directory: Directory) -> ZipListing:
    """Sort out a zip's members; of two with one name the later one counts.

    Raises:
        ValueError: the directory is damaged.
    """
    names, members = members_of(directory)
    encrypted = (members["flags"] & _ENCRYPTED).astype(bool).tolist()
    rows: dict[str, int] = {}
    faults: list[tuple[str, str]] = []
    for row, (name, locked) in enumerate(zip(names, encrypted, strict=True)):
        file = name.replace("\\", "/")
        if _ordinary(file) and not locked:
            if not file.endswith("/"):
                rows[file] = row
            continue
        parts = file.split("/")
        if (
            not file
            or name.endswith("/")
            or any(is_hidden(part) for part in parts if part not in (".", ".."))
        ):
            continue
        if file.startswith("/") or ".." in parts or ":" in parts[0]:
            faults.append((file, "unsafe name in the zip (absolute or with ..)"))
        elif locked:
            faults.append((file, "encrypted in the zip"))
        else:
            rows[file] = row
    files = sorted(rows)
    return ZipListing(tuple(files), members[[rows[file] for file in files]], tuple(sorted(faults)))


def _ordinary(file: str) -> bool:
    """Whether a zip's name is plainly neither hidden nor unsafe; most are, and a zip may have a million."""
    odd = not file or file.startswith((".", "/")) or "/." in file or ":" in file or "__MACOSX" in file
    return not odd


def digest_of(directory: Directory) -> str:
    """What tells this directory from any other."""
    digest = hashlib.blake2b(directory.content, digest_size=32)
    digest.update(repr((directory.start, directory.shift)).encode())
    return digest.hexdigest()


def remember_zip(file: Path, digest: str, listing: ZipListing, layout: str) -> None:
    """Keep a listing with the layout that was recognised; that nothing can be kept is no error."""
    note = {"directory": digest, "faults": listing.faults, "layout": layout}
    keep(file, Kept(listing.files, listing.members, note))


def recall_zip(file: Path, digest: str) -> RememberedZip | None:
    """The listing and the layout that are kept if they were made from this very directory, else None."""
    kept = read_kept(file)
    if kept is None or kept.note.get("directory") != digest or kept.array.dtype != MEMBER:
        return None
    faults = tuple((name, why) for name, why in kept.note["faults"])
    return RememberedZip(ZipListing(kept.names, kept.array, faults), kept.note["layout"])
