"""Whitening, fitting, panels, swaps, meshes and photographs with a renderer's further factors."""

import pytest
import torch

from derender.model import Derenderer
from derender.training.config import FeatureSettings
from derender.training.features import make_features

SIZE = 32
RENDERERS = ("phong+haze", "sh")


@pytest.fixture(scope="module", params=RENDERERS)
def model(request) -> Derenderer:
    """An untrained model with whitening and fitting of noise."""
    net = Derenderer.from_preset(
        "small", seed=0, image_size=SIZE, width=4, light_width=4, renderer=request.param
    )
    images = torch.rand(12, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    settings = FeatureSettings.model_validate(
        {"whitening": {"pictures": 12}, "fitting": {"examples": 12, "coordinates": 4}}
    )
    return make_features(net.eval().requires_grad_(False), images, settings)


def test_features_and_fitted_scenes_hold_further_factors(model, generator):
    images = torch.rand(3, 3, SIZE, SIZE, generator=generator)
    assert {row.name for row in model.factors} == set(model.embed(images))
    found, start = model.fit_scenes(images, 12), model.decompose(images)
    assert (found.after < found.before).all()
    extra = {name for name in found.scene.parameters if name not in ("depth", "albedo", "light", "camera")}
    assert extra == ({"environment"} if model.renderer.name == "sh" else {"specular", "haze"})
    for name in extra:
        moved = (found.scene.extra[name] - start.extra[name]).abs().amax(dim=1)
        assert (moved > 1e-3).all()
    model.renderer.check(found.scene)
    alone = model.fit_scenes(images[1:2], 12).scene
    assert torch.equal(alone.depth[0], found.scene.depth[1])
