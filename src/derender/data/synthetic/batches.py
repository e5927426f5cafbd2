"""Pictures made in batches on threads, and joined to one set: what the generators of faces and cars share.

A batch is a run of consecutive pictures, whole objects where they fit, and writes into its rows of the
result. So the threads decide when a picture is made and nothing else.
"""

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from numpy import ndarray

from derender.data.synthetic.synthetic_set import SyntheticSet

FOV_DEG = 10.0
Row = dict[str, int | float | np.float32 | str]
Maps = dict[str, ndarray]  # a SyntheticSet's arrays by name
_BATCH = 16  # pictures of 64 pixels


def make_set(
    work: Callable[[range, Maps], list[tuple[Row, Row]]],
    count: int,
    image_size: int,
    first: int,
    per_object: int,
    part_names: tuple[str, ...],
    progress: Callable[[int, int], None] | None = None,
) -> SyntheticSet:
    """The set of ``count`` pictures from index ``first`` on.

    ``work(indices, maps)`` fills the maps of these pictures and returns labels and traits of each.
    """
    out = _empty(count, image_size)
    labels: list[Row] = []
    traits: list[Row] = []

    def batch(rows: slice) -> list[tuple[Row, Row]]:
        part = {name: value[rows] for name, value in out.items()}
        return work(range(first + rows.start, first + rows.stop), part)

    batches = _batches(first, count, per_object, max(1, _BATCH * 64 // image_size))
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        for rows, found in zip(batches, pool.map(batch, batches), strict=True):
            labels += [label for label, _ in found]
            traits += [trait for _, trait in found]
            if progress is not None:
                progress(rows.stop, count)
    return SyntheticSet(
        **out,
        labels=_columns(labels),
        identity_traits=_columns(traits),
        part_names=part_names,
        fov_deg=FOV_DEG,
    )


def check_request(count: int, image_size: int, seed: int, first: int) -> None:
    """Raise ValueError for a number that no set can have."""
    if count < 1:
        raise ValueError(f"count must be 1 or more, got {count}")
    if not 16 <= image_size <= 1024:
        raise ValueError(f"image_size must be 16..1024 pixels, got {image_size}")
    if seed < 0 or first < 0:
        raise ValueError(f"seed and first must be 0 or more, got seed {seed}, first {first}")


def _batches(first: int, count: int, per_object: int, most: int) -> list[slice]:
    """Consecutive rows to work on together: whole objects where they fit into ``most`` rows."""
    whole = max(1, most // per_object) * per_object
    starts = [0]
    while starts[-1] < count:
        in_block = (first + starts[-1]) % whole
        starts.append(min(starts[-1] + min(whole - in_block, most), count))
    return [slice(a, b) for a, b in itertools.pairwise(starts)]


def _columns(rows: list[Row]) -> dict[str, ndarray]:
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def _empty(count: int, size: int) -> Maps:
    return {
        "images": np.zeros((count, 3, size, size), np.uint8),
        "depth": np.zeros((count, size, size), np.float32),
        "normal": np.zeros((count, size, size, 3), np.float32),
        "albedo": np.zeros((count, 3, size, size), np.uint8),
        "mask": np.zeros((count, size, size), bool),
        "parts": np.zeros((count, size, size), np.uint8),
        "light": np.zeros((count, 4), np.float32),
        "camera": np.zeros((count, 6), np.float32),
        "identity": np.zeros(count, np.int64),
    }
