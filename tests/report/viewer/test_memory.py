"""The viewer's memory of opened images is bounded: the longest unused leaves."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from derender.photo import Frame
from derender.report.viewer.images import Shelf, ShownImage
from derender.report.viewer.questions import Refused
from derender.scene import Scene


@pytest.fixture
def image() -> ShownImage:
    scene = Scene(torch.ones(1, 4, 4), torch.zeros(1, 3, 4, 4), torch.zeros(1, 4), torch.zeros(1, 6))
    small = np.zeros((3, 4, 4), np.uint8)
    return ShownImage(np.zeros((9, 9, 3), np.uint8), (), Frame.centred(9, 9), "none", small, scene, {})


def test_the_longest_unused_image_leaves_first(image):
    shelf = Shelf(3)
    first, second, third = (shelf.put(image) for _ in range(3))
    shelf.get(first)
    fourth = shelf.put(image)
    assert len(shelf) == 3 and all(shelf.get(name) is image for name in (first, third, fourth))
    with pytest.raises(Refused, match="no longer stored") as refused:
        shelf.get(second)
    assert refused.value.status == 410
    with pytest.raises(ValueError, match="room for 2"):
        Shelf(1)


def test_photographs_take_no_more_memory_than_allowed(image):
    shelf = Shelf(10, limit_bytes=3 * image.photo.nbytes)
    for _ in range(5):
        shelf.put(replace(image, photo=image.photo.copy()))
    assert len(shelf) == 3
    crops = Shelf(10, limit_bytes=image.photo.nbytes)
    for _ in range(5):
        crops.put(image)  # crops of one photograph
    assert len(crops) == 5


def test_names_cannot_be_guessed(image):
    names = {Shelf(200).put(image) for _ in range(200)}
    assert len(names) == 200 and all(re.fullmatch(r"[A-Za-z0-9_-]{22}", name) for name in names)
