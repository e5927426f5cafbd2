"""Files and folders that appear complete or not at all, and folders with checksums of their files.

Both are written under another name beside their place and moved there at the end: a kill or a full disk
leaves the previous content. The checksums of a sealed folder show a changed bit, but stop no attacker.
"""

import ctypes
import json
import os
import shutil
import tempfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from derender.storage.bounded import read_json

CHECKSUMS = "checksums.json"

_LONGEST_PREFIX = 80  # of a name's characters, so that temporary names are no longer than file systems allow
_PIECE_BYTES = 1 << 20
_THIS_FOLDER, _EXCHANGE = -100, 2  # AT_FDCWD and RENAME_EXCHANGE of Linux


class Damaged(ValueError):
    """A file is not what was written: cut off, changed or gone."""


class DamageNoticed(UserWarning):
    """Something damaged was passed over, and the work continues from an earlier state."""


@contextmanager
def atomic_file(path: Path, *, durable: bool = False) -> Iterator[Path]:
    """Give a temporary path to write to; it takes the place of ``path`` if nothing is raised.

    ``durable`` has the disk keep the content before the name. A link stays, and what it leads to is replaced.
    """
    path, (handle, name) = _begun(path, tempfile.mkstemp)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o644)
        if durable:
            _to_disk(temporary)
        temporary.replace(path)
        if durable:
            _to_disk(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def write_whole(path: str | Path, content: str | bytes) -> Path:
    """Write bytes, or text as UTF-8, whole or not at all; a failure leaves the old file."""
    with atomic_file(Path(path)) as temporary:
        temporary.write_bytes(content if isinstance(content, bytes) else content.encode())
    return Path(path)


@contextmanager
def atomic_folder(folder: Path, *, previous: Path | None = None) -> Iterator[Path]:
    """Give a temporary folder to fill; it takes the place of ``folder``, if nothing is raised.

    The old one becomes ``previous``, or is deleted. They are exchanged in one step where the system can
    (Linux); elsewhere the old one is moved first. A link stays, and what it leads to is replaced.
    """
    folder, name = _begun(folder, tempfile.mkdtemp)
    temporary = Path(name)
    aside = temporary.with_name(f"{temporary.name}-old") if previous is None else previous
    try:
        yield temporary
        temporary.chmod(0o755)
        sealed = (temporary / CHECKSUMS).exists()
        if not folder.exists():
            temporary.rename(folder)
        elif _exchanged(temporary, folder):
            if previous is not None and not _exchanged(temporary, previous):
                temporary.rename(previous)
        else:
            shutil.rmtree(aside, ignore_errors=True)
            folder.rename(aside)
            temporary.rename(folder)
        if sealed:
            _to_disk(folder.parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    if previous is None:
        shutil.rmtree(aside, ignore_errors=True)


@contextmanager
def new_folder(folder: str | Path, *, overwrite: bool = False, marker: str = "config.json") -> Iterator[Path]:
    """`atomic_folder` for a folder that must not exist yet, unless ``overwrite`` replaces a saved one."""
    require_replaceable(folder := Path(folder), overwrite, marker)
    with atomic_folder(folder) as temporary:
        yield temporary


def require_replaceable(folder: Path, overwrite: bool, marker: str = "config.json") -> None:
    """FileExistsError where a folder is there: without ``overwrite``, or with files but not this one."""
    if folder.exists() and not overwrite:
        raise FileExistsError(f"{folder} exists already: choose another folder or pass overwrite=True")
    if folder.exists() and not (folder / marker).is_file() and (folder.is_file() or any(folder.iterdir())):
        raise FileExistsError(f"{folder} has no {marker}, and its files would be lost: choose another folder")


def remove_abandoned(path: Path) -> None:
    """Delete what processes killed while writing this file or folder left; no process may be writing it."""
    for entry in path.parent.iterdir() if path.parent.is_dir() else ():
        if entry.name.startswith(_prefix(path)):
            if entry.is_dir():
                shutil.rmtree(entry, ignore_errors=True)
            else:
                entry.unlink(missing_ok=True)


def seal(folder: Path) -> None:
    """Note size and CRC-32 of every file in a folder beside them, and have the disk keep all of it."""
    result = {file.name: measured(file) for file in sorted(folder.iterdir())}
    (folder / CHECKSUMS).write_text(json.dumps({"crc32": result}))
    for file in (*folder.iterdir(), folder):
        _to_disk(file)


def check_seal(folder: Path) -> None:
    """Compare the files with what was noted; `Damaged` names the first that is missing or differs."""
    try:
        noted = read_json(folder / CHECKSUMS, dict[str, dict[str, tuple[int, int]]]).get("crc32", {})
    except FileNotFoundError as error:
        raise Damaged(f"{CHECKSUMS} is missing") from error
    except (OSError, ValueError) as error:
        raise Damaged(f"{CHECKSUMS} cannot be read") from error
    for name, (size, checksum) in noted.items():
        try:
            file = folder / Path(name).name
            result = measured(file) if file.stat().st_size == size else (file.stat().st_size, 0)
        except OSError as error:
            raise Damaged(f"{name} is missing or cannot be read") from error
        if result != (size, checksum):
            how = "its checksum differs" if result[0] == size else f"{result[0]:,} of {size:,} bytes"
            raise Damaged(f"{name} has changed since it was written: {how}")


def measured(file: Path) -> tuple[int, int]:
    """Size in bytes and CRC-32 of a file."""
    size = checksum = 0
    with file.open("rb") as stream:
        while piece := stream.read(_PIECE_BYTES):
            size += len(piece)
            checksum = zlib.crc32(piece, checksum)
    return size, checksum


def _begun(path: Path, make: Callable[..., Any]) -> tuple[Path, Any]:
    """The path, of a link what it leads to, and what ``make`` made beside it; errors name the former."""
    path = Path(os.path.realpath(path)) if path.is_symlink() else path
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        return path, make(prefix=_prefix(path), dir=path.parent)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


def _prefix(path: Path) -> str:
    return f".{path.name[:_LONGEST_PREFIX]}-"


def _to_disk(path: Path) -> None:
    """Wait until the disk has a file, or the names in a folder; where folders cannot be opened, go on."""
    try:
        handle = os.open(path, os.O_RDONLY)
    except PermissionError:  # a folder on Windows
        return
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _exchanged(one: Path, other: Path) -> bool:
    """Whether the system (Linux's renameat2) could let the two take each other's place in one step."""
    try:
        rename = ctypes.CDLL(None).renameat2
    except (OSError, AttributeError, TypeError):
        return False
    return rename(_THIS_FOLDER, os.fsencode(one), _THIS_FOLDER, os.fsencode(other), _EXCHANGE) == 0
