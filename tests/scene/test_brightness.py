"""Brightness shared between albedo and light: the rendering stays, dark objects get dark."""

import pytest
import torch

from derender import Derenderer
from derender.render import render_scene
from derender.scene import Scene
from derender.scene.brightness import BrightnessPrior, brightness_cues
from derender.training.config import FeatureSettings
from derender.training.features import fit_brightness, make_features

SIZE, COUNT = 16, 400


@pytest.fixture(scope="module")
def skins():
    """Surfaces of known luminance whose hue goes with it, in light that does not; (scene, true luminance)."""
    generator = torch.Generator().manual_seed(0)
    luminance = 0.3 + 0.4 * torch.rand(COUNT, generator=generator)
    hue = torch.stack([1.6 - luminance, torch.ones(COUNT), luminance + 0.2], dim=1)
    hue = hue / (hue @ torch.tensor([0.2126, 0.7152, 0.0722]))[:, None]
    albedo = (hue * luminance[:, None])[..., None, None].expand(-1, -1, SIZE, SIZE)
    intensity = 0.3 + 0.5 * torch.rand(COUNT, 2, generator=generator)
    light = torch.cat([intensity, torch.zeros(COUNT, 2)], dim=1)
    return Scene(torch.ones(COUNT, SIZE, SIZE), albedo.clone(), light, torch.zeros(COUNT, 6)), luminance


def dimmed(scene, luminance):
    """As inverse rendering leaves it: every albedo equally bright, the rest in the light."""
    factor = (0.5 / luminance)[:, None]
    light = torch.cat([scene.light[:, :2] / factor, scene.light[:, 2:]], dim=1)
    return scene.with_parameters(albedo=scene.albedo * factor[..., None, None], light=light)


def test_the_albedo_gets_its_brightness_back_and_the_rendering_stays(skins):
    truth, luminance = skins
    predicted = dimmed(truth, luminance)
    prior = BrightnessPrior.of(brightness_cues(predicted))
    shared = prior(predicted)
    result = brightness_cues(shared)[:, 0].exp()
    assert torch.corrcoef(torch.stack([result, luminance]))[0, 1] > 0.97
    slope = ((result - result.mean()) * (luminance - luminance.mean())).mean() / luminance.var()
    assert 0.8 < slope < 1.2
    light = brightness_cues(shared)[:, 1]
    assert abs(torch.corrcoef(torch.stack([light, luminance]))[0, 1]) < 0.2
    torch.testing.assert_close(render_scene(shared).image, render_scene(predicted).image, atol=1e-5, rtol=0)


def test_what_is_already_bright_is_not_pushed_over_1(skins):
    truth, _ = skins
    bright = truth.with_parameters(albedo=truth.albedo.clamp(min=0.97))
    prior = BrightnessPrior(red=0, blue=0, albedo=3, product=0)
    shared = prior(bright)
    assert shared.albedo.max() <= 1
    torch.testing.assert_close(render_scene(shared).image, render_scene(bright).image, atol=1e-5, rtol=0)


def test_a_model_estimates_keeps_and_applies_its_prior(tmp_path):
    model = Derenderer.from_preset("small", seed=0, image_size=32)
    images = torch.rand(8, 3, 32, 32, generator=torch.Generator().manual_seed(1))
    parts = {"whitening": {"pictures": 0}, "fitting": {"examples": 0, "steps": 0}}
    none = FeatureSettings.model_validate(parts)
    made = make_features(model, images, none)
    again = fit_brightness(made, images)  # of the scenes as decoded, not as shared already
    assert model.settings.brightness is None and made.settings.brightness and again
    assert again.model_dump() == pytest.approx(made.settings.brightness.model_dump(), rel=1e-2)
    before, after = model.decompose(images), made.decompose(images)
    assert not torch.equal(before.albedo, after.albedo)
    torch.testing.assert_close(model.render(before).image, made.render(after).image, atol=1e-4, rtol=0)
    made.save(tmp_path / "model")
    again = Derenderer.from_pretrained(tmp_path / "model")
    assert torch.equal(again.decompose(images).albedo, after.albedo)
    off = none.model_copy(update={"brightness": False})
    assert make_features(made, images, off).settings.brightness is None
