"""Keeps the memory of one training step for the next, on Linux with glibc.

glibc hands every large block back to the system when it is freed, and the system fills it with zeros, page
by page, when it is asked for again. A training step on a CPU frees and asks for hundreds of megabytes: it
spends up to a third of its time on that. Leaves other allocators, and memory of other devices, as they are.
"""

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_TRIM_THRESHOLD, _MMAP_MAX = -1, -4  # numbers of mallopt's parameters in glibc's malloc.h
_KEEP = {_TRIM_THRESHOLD: -1, _MMAP_MAX: 0}  # never trim; no blocks of their own mapping
_DEFAULT = {_TRIM_THRESHOLD: 128 * 1024, _MMAP_MAX: 65_536}


@contextmanager
def freed_memory_kept() -> Iterator[bool]:
    """Have the C library reuse freed memory instead of returning it; gives whether it could be told.

    Until the end of the block the process keeps its highest need.
    """
    mallopt = _mallopt()
    if mallopt is None:
        yield False
        return
    told = [mallopt(parameter, value) for parameter, value in _KEEP.items()]
    try:
        yield all(told)
    finally:
        for parameter, value in _DEFAULT.items():
            mallopt(parameter, value)


def _mallopt():
    return getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform.startswith("linux") else None
