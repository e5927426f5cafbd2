"""Controls are what they say, keep the images' names and labels, and repeat for the same seed."""

import numpy as np
import pytest
import torch
from sklearn.decomposition import PCA

from derender.baselines import controls
from derender.data import ImageSet
from derender.features import model_fingerprint
from derender.model import Derenderer
from derender.storage.places import optional


def pictures(count: int = 30, size: int = 8, seed: int = 0) -> ImageSet:
    images = np.random.default_rng(seed).integers(0, 256, (count, 3, size, size), dtype=np.uint8)
    files = tuple(f"{i}.png" for i in range(count))
    return ImageSet(images, files, {"who": np.arange(count) % 3}, source="made")


def test_pixels_are_the_pixels():
    given = pictures()
    table = controls.pixel_features(given)
    np.testing.assert_allclose(table.concatenate("pixels"), given.images.reshape(30, -1) / 255, rtol=1e-6)
    assert table.files == given.files and table.label("who").tolist() == given.labels["who"].tolist()
    assert table.origin == {"data": "made", "layout": "folder", "control": "pixels"}


def test_pca_takes_its_components_from_other_pictures():
    train, test = pictures(), pictures(6, seed=1)
    codes = controls.pca_features(test, components=4, fit_on=train).concatenate("pca")
    flat = [p.images.reshape(len(p), -1).astype(np.float32) / 255 for p in (train, test)]
    expected = PCA(4, whiten=True, random_state=0).fit(flat[0]).transform(flat[1])
    np.testing.assert_allclose(codes, expected, rtol=1e-4, atol=1e-4)
    with pytest.raises(ValueError, match="PCA needs 2 images or more"):
        controls.pca_features(train.select(slice(1)), components=1)
    with pytest.raises(ValueError, match=r"64 components cannot be had from 30 images: ask for 1 to 30"):
        controls.pca_features(train)


def test_an_untrained_twin_has_the_shape_not_the_weights_and_leaves_the_generator():
    small, state = Derenderer.from_preset("small", seed=5), torch.random.get_rng_state()
    first, again, other = (controls.untrained_twin(small, seed) for seed in (0, 0, 1))
    assert torch.equal(torch.random.get_rng_state(), state)
    assert model_fingerprint(first) == model_fingerprint(again) != model_fingerprint(other)
    assert model_fingerprint(first) != model_fingerprint(small)
    shapes = [{n: v.shape for n, v in m.state_dict().items()} for m in (first, small)]
    assert shapes[0] == shapes[1] and not first.training


def stripes(*images: np.ndarray) -> ImageSet:
    stack = np.stack([np.broadcast_to(image.astype(np.uint8), (3, *image.shape)) for image in images])
    files = tuple(f"{i}.png" for i in range(len(images)))
    return ImageSet(stack, files, {"n": np.arange(len(images))}, source="made")


def test_hog_knows_orientations_and_neither_brightness_nor_contrast():
    upright = np.tile(100 + 60 * np.sin(np.arange(32) / 2), (32, 1)).round()
    seen = []
    given = stripes(upright, upright.T, upright + 40, np.full((32, 32), 7))
    table = controls.descriptor_features("hog", given, progress=lambda *counts: seen.append(counts))
    values = table.factors["hog"]
    assert values.shape == (4, 3 * 3 * 2 * 2 * 9) and seen == [(4, 4)]
    assert controls.descriptor_features("hog", stripes(np.zeros((64, 64)))).factors["hog"].shape == (1, 1764)
    assert table.origin["control"] == "hog" and table.label("n").tolist() == [0, 1, 2, 3]
    by_orientation = values[:2].reshape(2, -1, 9).sum(axis=1)
    assert by_orientation.argmax(axis=1).tolist() == [0, 4]
    assert (by_orientation.max(axis=1) > 0.99 * by_orientation.sum(axis=1)).all()
    np.testing.assert_allclose(values[0], values[2], atol=1e-6)
    assert not values[3].any()
    assert (np.linalg.norm(values.reshape(4, -1, 36), axis=2) <= 1 + 1e-5).all()


def test_bad_input_and_a_missing_package_are_named():
    with pytest.raises(ValueError, match="12x12 pixels are too few: HOG needs 16 a side"):
        controls.descriptor_features("hog", stripes(np.zeros((12, 12))))
    with pytest.raises(ValueError, match=r"the baseline x needs the package no_such.*derender\[baselines\]"):
        optional("no_such.thing", "the baseline x")


def test_gradientfaces_are_the_same_in_brighter_light():
    shapes = np.add.outer(np.sin(np.arange(32) / 3), np.cos(np.arange(32) / 5))
    lit = stripes(*(100 + gain * shapes for gain in (25, 50, -50)))
    table = controls.descriptor_features("gradientfaces", lit)
    one, brighter, inverted = table.factors["gradientfaces"]
    assert one.shape == (2 * 32 * 32,) and one @ brighter > 0.97 * 32 * 32
    assert one @ inverted < -0.97 * 32 * 32
    ramp = controls.descriptor_features("gradientfaces", stripes(np.tile(np.arange(32), (32, 1)) * 4))
    np.testing.assert_allclose(ramp.factors["gradientfaces"], [[1] * 1024 + [0] * 1024], atol=1e-6)


def test_local_binary_patterns_are_shares_in_cells():
    upright = np.tile(100 + 60 * np.sin(np.arange(32) / 2), (32, 1)).round()
    values = controls.descriptor_features("lbp", stripes(upright, upright.T, upright + 40)).factors["lbp"]
    assert values.shape == (3, 16 * 59)
    np.testing.assert_allclose(np.linalg.norm(values.reshape(3, 16, 59), axis=2), 1, rtol=1e-5)
    np.testing.assert_array_equal(values[0], values[2])
    assert values[0] @ values[1] < 0.8 * 16
