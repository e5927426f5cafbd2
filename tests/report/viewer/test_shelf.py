"""A bounded number of pictures, of which the one goes that was not asked for longest."""

import re

import numpy as np
import pytest
import torch

from derender.report.viewer.questions import Refused
from derender.report.viewer.studio import Shelf, ShownImage
from derender.scene import Scene


@pytest.fixture
def taken() -> ShownImage:
    scene = Scene(torch.ones(1, 4, 4), torch.zeros(1, 3, 4, 4), torch.zeros(1, 4), torch.zeros(1, 6))
    return ShownImage(np.zeros((3, 4, 4), np.uint8), scene, {})


def test_the_longest_unused_goes_first(taken):
    shelf = Shelf(3)
    first, second, third = (shelf.put(taken) for _ in range(3))
    shelf.get(first)
    fourth = shelf.put(taken)
    assert len(shelf) == 3
    for name in (first, third, fourth):
        assert shelf.get(name) is taken
    with pytest.raises(Refused, match="no longer stored") as refused:
        shelf.get(second)
    assert refused.value.status == 410


def test_names_cannot_be_guessed(taken):
    shelf = Shelf(200)
    names = {shelf.put(taken) for _ in range(200)}
    assert len(names) == 200
    assert all(re.fullmatch(r"[A-Za-z0-9_-]{22}", name) for name in names)


def test_a_shelf_holds_a_pair():
    with pytest.raises(ValueError, match="room for 2"):
        Shelf(1)
