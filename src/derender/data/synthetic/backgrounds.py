"""What lies behind an object: a plain colour, a gradient between two, or smooth coloured noise.

Colours are muted, as rooms and skies are; a strong colour is rare.
"""

from functools import lru_cache

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

_NOISE_CELLS = 5


def draw_background(kind: str, generator: np.random.Generator, size: int) -> Float32[ndarray, "s s 3"]:
    """One background, values 0..1. Draws the same number of random values whatever the kind."""
    grey = generator.random((2, 1), dtype=np.float32)
    strength = np.float32(0.15 + 0.45 * generator.random() ** 2)
    ends = grey + strength * (generator.random((2, 3), dtype=np.float32) - grey)
    angle = np.float32(generator.uniform(0.0, 2.0 * np.pi))
    knots = generator.random((_NOISE_CELLS, _NOISE_CELLS, 3), dtype=np.float32)
    if kind == "plain":
        return np.broadcast_to(ends[0], (size, size, 3)).copy()
    if kind == "gradient":
        across = np.linspace(-1.0, 1.0, size, dtype=np.float32)
        at = 0.5 + 0.5 * (np.cos(angle) * across + np.sin(angle) * across[:, None]) / np.float32(np.sqrt(2.0))
        return ends[0] + (ends[1] - ends[0]) * at[..., None]
    knots = (
        ends[0]
        + (ends[1] - ends[0]) * knots[..., :1]
        + np.float32(0.3) * strength * (knots - np.float32(0.5))
    )
    knots = np.clip(knots, 0.0, 1.0)
    return _stretch(_stretch(knots, size).transpose(1, 0, 2), size).transpose(1, 0, 2)


def _stretch(knots: ndarray, size: int) -> ndarray:
    """Smooth interpolation of rows of knots to ``size`` rows."""
    low, part = _between(size)
    return knots[low] * (1.0 - part) + knots[low + 1] * part


@lru_cache(maxsize=4)
def _between(size: int) -> tuple[ndarray, ndarray]:
    """The knot before each row, and how far the row is on its way to the next one."""
    at = np.linspace(0.0, _NOISE_CELLS - 1.0, size, dtype=np.float32)
    low = np.minimum(at.astype(int), _NOISE_CELLS - 2)
    part = at - low
    return low, (part * part * (3.0 - 2.0 * part))[:, None, None].astype(np.float32)
