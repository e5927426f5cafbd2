"""Variety of view and of light: what geometry is learned from when nobody labels anything.

View: how far a picture is from its own mirror image, against how far it is from other pictures' mirror
images. Things seen from the front only are nearly their own mirror images, whoever they are; a turned head or
car is not. Light: how much brighter the left of the picture's middle is than the right, in its upper and its
lower half; light from the side moves both together, marks and noise do not, so what the halves share is
counted. Leaves out light from above or below, which cannot be told from hair and foreheads, and views that
differ by tilt alone.
"""

import numpy as np
from jaxtyping import Float, Float32

from derender.data.doctor.structure import mirrored

_MIDDLE = slice(10, 16), slice(16, 22)  # of 32 pixels, on either side of the middle
_CLIP = 0.01  # share at each end that is drawn in before spreads are taken


def own_mirror_distance(structure: Float32[np.ndarray, "n 6 6 8"]) -> Float[np.ndarray, " n"]:
    """1 - cosine between each picture's structure and that of its mirror image, 0..2."""
    return 1 - (structure * mirrored(structure)).sum(axis=(1, 2, 3), dtype=np.float64)


def view_variety(structure: Float32[np.ndarray, "n 6 6 8"]) -> float:
    """Mean distance to the own mirror image over that to another's: 0 all frontal, 1 from everywhere."""
    count = len(structure)
    own = own_mirror_distance(structure)
    total = structure.sum(axis=0, dtype=np.float64)
    to_others = 1 - ((total * mirrored(total)).sum() - (1 - own).sum()) / (count * (count - 1))
    return float(own.mean() / max(to_others, 1e-9))


def side_light(grey: Float32[np.ndarray, "n 32 32"]) -> Float[np.ndarray, "n 2"]:
    """(left - right) / (left + right) of the middle's upper and lower half, -1..1; above 0: lit from left."""
    low, high = _MIDDLE
    halves = []
    for rows in (low, high):
        left = grey[:, rows, low].mean(axis=(1, 2), dtype=np.float64)
        right = grey[:, rows, high].mean(axis=(1, 2), dtype=np.float64)
        halves.append((left - right) / (left + right + 0.02))
    return np.stack(halves, axis=1)


def light_variety(sides: Float[np.ndarray, "n 2"]) -> float:
    """Standard deviation of side light that both halves share; 0 (or less, by chance): all lit alike."""
    upper, lower = (np.clip(half, *np.quantile(half, (_CLIP, 1 - _CLIP))) for half in sides.T)
    shared = float(np.cov(upper, lower)[0, 1])
    return float(np.sign(shared) * np.sqrt(abs(shared)))
