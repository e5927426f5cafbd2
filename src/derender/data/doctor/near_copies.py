"""Finds pictures that are nearly the same: shifted by a pixel or two, brightened, compressed again.

Two pictures are near copies if their 16 x 16 grey versions, mean and contrast taken off, correlate by
``LIMITS.copy_correlation`` or more. Candidates come from a k-d tree over the leading principal components, in
which no two near copies can be farther apart than in full; groups are connected pairs, so that chains count
as one. Leaves out colour, mirrored copies, and copies cropped otherwise.
"""

import numpy as np
from jaxtyping import Float32, Int64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from derender.data.doctor.limits import LIMITS

_COMPONENTS, _NEIGHBOURS, _SAMPLE = 12, 6, 4_000


def near_copy_groups(tiny: Float32[np.ndarray, "n d"]) -> Int64[np.ndarray, " n"]:
    """For each picture the first picture of its group; itself where it has no earlier near copy.

    ``tiny`` has rows of length 1 (or 0: blank pictures, which are copies of one another).
    """
    group = np.arange(len(tiny))
    places = _leading_components(tiny)
    standing = group.copy()
    while len(standing) > 1:
        firsts = _merged(tiny[standing], places[standing])
        merged = standing[firsts]
        if (merged == standing).all():
            break
        new_first = np.arange(len(tiny))
        new_first[standing] = merged
        group = new_first[group]
        standing = np.unique(merged)
    return group


def _leading_components(tiny: Float32[np.ndarray, "n d"]) -> Float32[np.ndarray, "n k"]:
    """Coordinates along the directions of most variance, which are found on a sample."""
    sample = tiny[np.unique(np.linspace(0, len(tiny) - 1, _SAMPLE).astype(int))]
    _, directions = np.linalg.eigh(np.cov(sample, rowvar=False) if len(sample) > 1 else np.eye(tiny.shape[1]))
    return (tiny @ directions[:, -_COMPONENTS:]).astype(np.float32)


def _merged(tiny: Float32[np.ndarray, "m d"], places: Float32[np.ndarray, "m k"]) -> Int64[np.ndarray, " m"]:
    """One round: pairs among each picture's nearest, joined; the first row of each row's group."""
    reach = float(np.sqrt(2 - 2 * LIMITS.copy_correlation))
    near = min(_NEIGHBOURS + 1, len(tiny))
    _, other = KDTree(places).query(places, k=near, distance_upper_bound=reach * 1.001)
    first = np.repeat(np.arange(len(tiny)), near)
    second = other.reshape(-1)
    real = (second < len(tiny)) & (second != first)
    first, second = first[real], second[real]
    keep = _close(tiny, first, second, reach)
    pairs = coo_array((np.ones(keep.sum(), np.int8), (first[keep], second[keep])), shape=(len(tiny),) * 2)
    label = connected_components(pairs, directed=False)[1]
    earliest = np.full(label.max() + 1, len(tiny))
    np.minimum.at(earliest, label, np.arange(len(tiny)))
    return earliest[label]


def _close(tiny: np.ndarray, first: np.ndarray, second: np.ndarray, reach: float) -> np.ndarray:
    """Which pairs are within ``reach`` in full, a bounded number at a time."""
    close = np.empty(len(first), bool)
    for start in range(0, len(first), 65_536):
        part = slice(start, start + 65_536)
        close[part] = ((tiny[first[part]] - tiny[second[part]]) ** 2).sum(axis=1) <= reach**2
    return close
