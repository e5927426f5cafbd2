"""Controls whitened by a model's renderings: the model itself as in training, others by the same rule."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from derender.data import ImageSet
from derender.data.synthetic import faces
from derender.evaluation.controls import Renderings
from derender.evaluation.memory import Memory
from derender.features import embed_images
from derender.model import Derenderer
from derender.training.config import FeatureSettings, WhiteningSettings
from derender.training.features import fit_whitening

SETTINGS = FeatureSettings(whitening=WhiteningSettings(pictures=40, views=2, directions=6))


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    return faces.generate(48, 32, 0).images


@pytest.fixture(scope="module")
def renderings(images) -> Renderings:
    return Renderings(net(0), images[:40], SETTINGS)


def net(seed: int) -> Derenderer:
    return Derenderer.from_preset("small", seed=seed, image_size=32, width=4, light_width=4, code_size=12)


def test_a_model_whitens_itself_as_training_does(renderings):
    result = renderings.whiten(renderings.model).whitening
    images = torch.from_numpy(renderings.images)
    expected = fit_whitening(renderings.model, images, SETTINGS.whitening, SETTINGS.perturb)
    assert result is not None and sorted(result.names) == ["albedo", "geometry"]
    for name, value in result.named_buffers():
        torch.testing.assert_close(expected.get_buffer(name), value)
    assert renderings.model.whitening is None


def test_features_there_are_already_change_nothing(renderings, images):
    fitted = renderings.whiten(renderings.model)
    assert fitted.whitening is not None and fitted.whitening.mirrored
    again = replace(renderings, model=fitted).whiten(fitted)
    expected = embed_images(fitted, images)
    for name, feature in embed_images(again, images).items():
        np.testing.assert_array_equal(feature, expected[name])


def test_another_encoder_is_whitened_by_its_own_codes_of_the_renderings(renderings, images):
    other = net(1)
    result = renderings.whiten(other)
    features, codes = (embed_images(one, images) for one in (result, other))
    assert np.linalg.matrix_rank(features["geometry"]) <= 6 < np.linalg.matrix_rank(codes["geometry"])
    np.testing.assert_allclose(features["light"], codes["light"], rtol=1e-5)
    own = renderings.whiten(renderings.model).whitening
    assert own is not None and result.whitening is not None
    assert not torch.allclose(result.whitening.get_buffer("geometry_map"), own.get_buffer("geometry_map"))


def test_components_are_whitened_and_cached(renderings, images, tmp_path):
    pictures = ImageSet(images[40:], tuple("abcdefgh"))
    assert renderings.n_components == 10
    keeping = replace(renderings, memory=Memory(tmp_path))
    one, two = (keeping.components(pictures).factors["pca"] for _ in range(2))
    assert (keeping.memory.made, keeping.memory.recalled) == (1, 1)
    np.testing.assert_array_equal(one, two)
    assert one.shape == (8, 10) and np.linalg.matrix_rank(one) <= 6
    np.testing.assert_allclose(one, renderings.components(pictures).factors["pca"], rtol=1e-5)
