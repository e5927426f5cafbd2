"""Histograms see where edges point and nothing of brightness."""

import numpy as np
import pytest

from derender.baselines.extras import optional
from derender.baselines.hog import hog_features
from derender.data import PictureSet


def pictures(*images: np.ndarray) -> PictureSet:
    stack = np.stack([np.broadcast_to(image.astype(np.uint8), (3, 32, 32)) for image in images])
    files = tuple(f"{i}.png" for i in range(len(images)))
    return PictureSet(stack, files, {"n": np.arange(len(images))}, source="made")


WAVE = 100 + 60 * np.sin(np.arange(32) / 2)


def test_sizes_and_the_known_number_at_64():
    table = hog_features(pictures(np.tile(WAVE, (32, 1))))
    assert table.factors["hog"].shape == (1, 3 * 3 * 2 * 2 * 9)
    large = PictureSet(np.zeros((1, 3, 64, 64), np.uint8), ("a",), source="made")
    assert hog_features(large).factors["hog"].shape == (1, 1764)
    assert table.origin["control"] == "hog" and table.label("n").tolist() == [0]


def test_vertical_stripes_fill_the_first_orientation_horizontal_ones_the_middle():
    upright, level = np.tile(WAVE, (32, 1)), np.tile(WAVE[:, None], (1, 32))
    by_orientation = hog_features(pictures(upright, level)).factors["hog"].reshape(2, -1, 9).sum(axis=1)
    assert by_orientation.argmax(axis=1).tolist() == [0, 4]
    assert (by_orientation.max(axis=1) > 0.99 * by_orientation.sum(axis=1)).all()


def test_brightness_and_contrast_do_not_matter_and_a_flat_picture_is_zero():
    wave = np.tile(WAVE, (32, 1)).round()
    values = hog_features(pictures(wave, wave + 40, np.full((32, 32), 7))).factors["hog"]
    np.testing.assert_allclose(values[0], values[1], atol=1e-6)
    assert not values[2].any()
    assert (np.linalg.norm(values.reshape(3, -1, 36), axis=2) <= 1 + 1e-5).all()


def test_bad_input_and_a_missing_package_are_named():
    with pytest.raises(
        ValueError, match="cells of 20 pixels do not fit 2 a side into 32x32: ask for 1 to 16"
    ):
        hog_features(pictures(np.zeros((32, 32))), cell_px=20)
    with pytest.raises(ValueError, match=r"the baseline x needs the package no_such.*derender\[baselines\]"):
        optional("no_such.thing", "the baseline x")
