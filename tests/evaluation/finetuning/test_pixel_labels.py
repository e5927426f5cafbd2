"""Labels found by pixels: in any order, mirrored, unknown where pictures disagree."""

import numpy as np
import pytest
import torch

from derender.evaluation.finetuning.pixel_labels import PixelLabels
from derender.training.batches import Batches

CPU = torch.device("cpu")


@pytest.fixture
def images() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (300, 3, 8, 8), dtype=np.uint8)


def test_every_batch_of_the_loop_gets_its_labels(images):
    targets = np.random.default_rng(1).integers(-1, 2, (300, 2)).astype(np.int8)
    labels = PixelLabels(images, targets, CPU)
    batches, seen = Batches(torch.from_numpy(images), 60, seed=3, horizontal_flips=True), []
    for position in range(5):
        batch = batches.at(position)
        found = labels.of(batch)
        for picture, target in zip((batch * 255).round().numpy(), found.numpy(), strict=True):
            either = [(images == view).all(axis=(1, 2, 3)) for view in (picture, picture[..., ::-1])]
            (row,) = np.flatnonzero(either[0] | either[1])
            assert (targets[row] == target).all()
            seen.append(row)
    assert sorted(seen) == list(range(300))
    assert (labels.of(torch.from_numpy(images[:9]).float() / 255).numpy() == targets[:9]).all()


def test_alike_or_mirrored_pictures_that_disagree_are_unknown(images):
    images = np.concatenate([images, images[:1, :, :, ::-1], images[1:2]])
    targets = np.ones((302, 2), np.int8)
    targets[300] = [0, 1]
    labels = PixelLabels(images, targets, CPU)
    first = labels.of(torch.from_numpy(images[:3].copy()).float() / 255)
    assert first.tolist() == [[-1, 1], [1, 1], [1, 1]]


def test_a_strange_picture_is_our_own_mistake(images):
    labels = PixelLabels(images, np.ones((300, 1), np.int8), CPU)
    with pytest.raises(AssertionError, match="only pictures of the run"):
        labels.of(torch.zeros(2, 3, 8, 8))
