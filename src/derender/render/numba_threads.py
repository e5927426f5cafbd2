"""How Numba kernels are compiled and run here: one compiled loop per range of images, ranges on threads.

A kernel is compiled with ``nogil`` and takes the range of images it works on. ``over_images`` runs ranges in
a thread pool as wide as ``torch.get_num_threads()``. This replaces Numba's ``parallel=True``: its default
threading layer may not be entered from two Python threads, and its OpenMP layer does not survive a fork.
Compiled kernels are cached beside the package, or in the user's cache folder where the package is read-only
(``NUMBA_CACHE_DIR`` overrides). Where no folder can be written, they are compiled in every process.
"""

import inspect
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

PORTIONS_PER_THREAD = 4


def kernel(function: Callable[..., Any], **own: Any) -> Callable[..., Any]:
    """Compile on first use, without the interpreter lock, keeping the machine code on disk where possible."""
    function = inspect.unwrap(function)  # type checks may wrap it
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", **own}
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no folder can be written
        return numba.njit(**options)(function)


def array(tensor: Tensor) -> np.ndarray:
    """The tensor's memory (a copy if it is not contiguous) as kernels take it."""
    return tensor.detach().contiguous().numpy()


def over_images(function: Callable[..., None], count: int, *arguments: Any) -> None:
    """Call ``function(*arguments, start, stop)`` on ranges that together make up ``range(count)``."""
    threads = min(torch.get_num_threads(), count)
    if threads <= 1:
        function(*arguments, 0, count)
        return
    portions = min(count, threads * PORTIONS_PER_THREAD)
    edges = [count * portion // portions for portion in range(portions + 1)]
    pool = _pool(threads, os.getpid())
    list(pool.map(lambda start, stop: function(*arguments, start, stop), edges[:-1], edges[1:]))


@lru_cache(maxsize=4)
def _pool(threads: int, process: int) -> ThreadPoolExecutor:
    """One pool per process: after a fork, the parent's threads do not exist in the child."""
    return ThreadPoolExecutor(threads, thread_name_prefix=f"derender-numba-{process}")
