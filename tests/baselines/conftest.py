"""Small images with something in them to learn: two colours, a place, and a label for each."""

import numpy as np
import pytest

from derender.data import ImageSet


@pytest.fixture(scope="session")
def blobs() -> ImageSet:
    """48 images of 32x32: a bright square on a dark ground, left (label 0) or right (label 1)."""
    random = np.random.default_rng(0)
    images = random.integers(0, 60, (48, 3, 32, 32), dtype=np.uint8)
    side = np.arange(48) % 2
    for image, right in zip(images, side, strict=True):
        row, column = random.integers(4, 16), 18 if right else 2
        image[:, row : row + 10, column : column + 10] = random.integers(120, 256, (3, 1, 1))
    labels = {"side": side, "shade": np.array(["dark", "light"])[side], "same": np.zeros(48, int)}
    return ImageSet(images, tuple(f"{i:02d}.png" for i in range(48)), labels, source="made by the test")
