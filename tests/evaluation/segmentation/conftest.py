"""Images that masks can be read from: three bands, each of its own colour, at places that vary."""

import numpy as np
import pytest
import torch

from derender import Derenderer
from derender.data import ImageSet
from derender.evaluation.segmentation import SegmentationData, divide

COLOURS = np.array([[200, 30, 30], [30, 200, 30], [30, 30, 200], [120, 120, 120]], np.uint8)
NAMES = ("sky", "wall", "floor", "nothing")


def bands(count: int = 40, size: int = 32) -> tuple[ImageSet, np.ndarray]:
    """Bands of sky, wall and floor with edges that move; the fourth class is never shown."""
    random = np.random.default_rng(0)
    masks = np.zeros((count, size, size), np.uint8)
    for mask in masks:
        first, second = sorted(random.integers(4, size - 4, 2))
        mask[first:] = 1
        mask[second:] = 2
    images = np.moveaxis(COLOURS[masks], -1, 1).astype(int) + random.integers(-20, 20, (count, 3, size, size))
    files = tuple(f"{row:03d}.png" for row in range(count))
    return ImageSet(images.clip(0, 255).astype(np.uint8), files, source="made by the test"), masks


@pytest.fixture(scope="session")
def data() -> SegmentationData:
    return divide(*bands(), NAMES, test_fraction=0.4)


@pytest.fixture(scope="session")
def model() -> Derenderer:
    unets = {"encoder": "unet", "unet_width": 4, "unet_decoder": True}
    sizes = {"image_size": 32, "width": 4, "light_width": 4, **unets}
    return Derenderer.from_preset("small", seed=0, **sizes).eval().requires_grad_(False)


@pytest.fixture
def before(model):
    """Checks at the end that the model is as it was."""
    kept = {name: value.clone() for name, value in model.state_dict().items()}
    yield
    assert all(torch.equal(value, kept[name]) for name, value in model.state_dict().items())
    assert not any(parameter.requires_grad for parameter in model.parameters())
