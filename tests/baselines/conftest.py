"""Small images with something in them to learn: two colours, a place, and a label for each."""

from contextlib import nullcontext

import numpy as np
import pytest
import torch

from derender.baselines.model import LossInputs
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


@pytest.fixture(scope="session")
def losses():
    """The losses of a batch, whose random numbers come from a seed or a generator."""

    def of(model, images, config, random=0, aid=None) -> dict[str, torch.Tensor]:
        generator = torch.Generator().manual_seed(random) if isinstance(random, int) else random
        return model.losses(images, LossInputs(config, generator, nullcontext, aid))

    return of


@pytest.fixture(scope="session")
def seeded():
    """Build something with the global generator at a seed, and leave that as it was."""

    def build(function, *arguments, seed=0, **named):
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            return function(*arguments, **named)

    return build
