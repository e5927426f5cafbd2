"""Images of noise that runs learn from."""

import numpy as np
import torch
from safetensors.torch import load_file

from derender.data import ImageSet
from derender.training.checkpoint import WEIGHTS_FILE


def noise_set(count: int, cells: int = 32) -> ImageSet:
    """So many images of 32 pixels, of as many cells a side."""
    coarse = np.random.default_rng(0).integers(0, 256, (count, 3, cells, cells), dtype=np.uint8)
    pixels = coarse.repeat(32 // cells, axis=2).repeat(32 // cells, axis=3)
    return ImageSet(pixels, tuple(f"{number:03d}.png" for number in range(count)), source="made by the test")


def weights(run, which: str = "last") -> dict[str, torch.Tensor]:
    """Those of a checkpoint."""
    return load_file(run / "checkpoints" / which / WEIGHTS_FILE)


def assert_same_weights(one, two):
    first, second = weights(one), weights(two)
    assert first.keys() == second.keys()
    assert all(torch.equal(first[name], second[name]) for name in first)
