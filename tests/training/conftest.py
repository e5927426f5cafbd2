"""Images of noise that runs learn from."""

import numpy as np

from derender.data import ImageSet


def noise_set(count: int, cells: int = 32) -> ImageSet:
    """So many images of 32 pixels, of as many cells a side."""
    coarse = np.random.default_rng(0).integers(0, 256, (count, 3, cells, cells), dtype=np.uint8)
    pixels = coarse.repeat(32 // cells, axis=2).repeat(32 // cells, axis=3)
    return ImageSet(pixels, tuple(f"{number:03d}.png" for number in range(count)), source="made by the test")
