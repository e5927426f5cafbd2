"""Decodes many pictures on all cores into one array.

Threads suffice: Pillow decodes without Python's global lock. Rows of unreadable pictures (and of copies)
are closed up in place, so that no second array is needed.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt8

from derender.data.decode import Unreadable, decode, quiet_pillow
from derender.data.duplicates import Duplicate, find_duplicates, pixel_digest
from derender.data.source import Skipped, Source

Progress = Callable[[int, int], object]
"""Called with (pictures done, pictures in all), from the calling thread."""

_CHUNK = 32


@dataclass(frozen=True)
class Loaded:
    """What became of the files: those whose pictures are the first rows of the array, and the others."""

    files: tuple[str, ...]
    skipped: tuple[Skipped, ...]
    duplicates: tuple[Duplicate, ...]


def load_into(
    images: UInt8[np.ndarray, "n 3 s s"],
    source: Source,
    files: Sequence[str],
    *,
    fit: str,
    keep_duplicates: bool,
    boxes: Float32[np.ndarray, "n 4"] | None = None,
    progress: Progress | None = None,
    workers: int | None = None,
) -> Loaded:
    """Decode ``files`` into ``images``; the result's files are the first rows, the rows after them are waste.

    Copies are found whether or not they are dropped. ``boxes`` has a row for each file (data/layout.py).
    """
    size = images.shape[-1]

    def load(start: int) -> list[bytes | Unreadable]:
        return [
            _load_one(images[row], source, files[row], size, fit, None if boxes is None else boxes[row])
            for row in range(start, min(start + _CHUNK, len(files)))
        ]

    outcomes: list[bytes | Unreadable] = []
    with quiet_pillow(), decoding_threads(workers or usable_cores()) as pool:
        for part in pool.map(load, range(0, len(files), _CHUNK)):
            outcomes.extend(part)
            if progress is not None:
                progress(len(outcomes), len(files))

    skipped = tuple(
        Skipped(file, str(outcome))
        for file, outcome in zip(files, outcomes, strict=True)
        if isinstance(outcome, Unreadable)
    )
    readable = [(row, outcome) for row, outcome in enumerate(outcomes) if isinstance(outcome, bytes)]
    duplicates = find_duplicates([files[row] for row, _ in readable], [digest for _, digest in readable])
    dropped = set() if keep_duplicates else {duplicate.file for duplicate in duplicates}
    kept = [row for row, _ in readable if files[row] not in dropped]
    for target, row in enumerate(kept):
        if target != row:
            images[target] = images[row]
    return Loaded(tuple(files[row] for row in kept), skipped, duplicates)


def usable_cores() -> int:
    """The cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _load_one(
    target: np.ndarray, source: Source, file: str, size: int, fit: str, box: np.ndarray | None
) -> bytes | Unreadable:
    """Decode one file into its row and digest its pixels, or say why that cannot be done."""
    try:
        encoded = source.read(file)
    except ValueError as problem:
        return Unreadable(str(problem))
    except OSError as problem:
        return Unreadable(f"cannot be read: {problem.strerror or problem}")
    if not encoded:
        return Unreadable("empty file")
    try:
        target[:] = decode(encoded, size, fit, box)
    except Unreadable as problem:
        return problem
    return pixel_digest(target)


@contextmanager
def decoding_threads(count: int) -> Iterator[ThreadPoolExecutor]:
    """A pool that drops the work not yet begun when an error or Ctrl-C ends the block."""
    pool = ThreadPoolExecutor(count, thread_name_prefix="decode")
    try:
        yield pool
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
