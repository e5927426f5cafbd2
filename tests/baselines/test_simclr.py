"""SimCLR: its augmentations obey their laws, its loss another implementation's, physical views re-render."""

import math

import pytest
import torch
from pytorch_metric_learning.losses import NTXentLoss

from derender.baselines import simclr
from derender.model import Derenderer
from derender.scene.perturb import PerturbSettings

OFF = simclr.AugmentSettings(crop_from=1.0, aspect=1.0, flip=0, jitter=0, grey=0, blur=0)
STILL = simclr.AugmentSettings(brightness=0, contrast=0, saturation=0, hue_deg=0)
TINY = simclr.SimclrSettings(image_size=32, width=8, code_size=16, projection=6)


@pytest.fixture
def images() -> torch.Tensor:
    return torch.rand(6, 3, 20, 24, generator=torch.Generator().manual_seed(1))


def drawn(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_views_stay_in_range_repeat_for_a_generator_and_differ_between_images(images):
    torch.testing.assert_close(simclr.augment(images, OFF, drawn()), images)
    first, again, other = (simclr.augment(images, simclr.AugmentSettings(), drawn(n)) for n in (0, 0, 1))
    assert torch.equal(first, again) and not torch.equal(first, other)
    assert first.shape == images.shape and 0 <= first.min() <= first.max() <= 1
    views = simclr.augment(images[:1].expand(6, -1, -1, -1), simclr.AugmentSettings(), drawn())
    assert all(not torch.equal(views[0], views[i]) for i in range(1, 6))


def test_a_crop_lies_inside_the_image():
    for seed in range(20):
        ramp = torch.linspace(0, 1, 24).expand(50, 3, 20, 24)
        part = simclr.crop(ramp, simclr.AugmentSettings(crop_from=0.1), drawn(seed))
        assert part.min() >= 0 and part.max() <= 1
        widths = part[:, 0, 0, -1] - part[:, 0, 0, 0]
        assert widths.min() > math.sqrt(0.1 * 0.75) - 2 / 24 and widths.max() <= 1
        assert (part[:, 0, 0].diff(dim=1) >= -1e-6).all()


def test_grey_is_the_luminance_and_hue_turns_red_to_green_and_leaves_grey(images):
    colourless = simclr.grey(images)
    luminance = sum(w * images[:, i] for i, w in enumerate(simclr.LUMINANCE))
    torch.testing.assert_close(colourless, luminance[:, None].expand_as(images))
    red, third = torch.tensor([1.0, 0, 0]).view(1, 3, 1, 1), torch.tensor([2 * math.pi / 3])
    green, angle = simclr.rotate_hue(red, third).flatten(), torch.full((6,), 0.7)
    torch.testing.assert_close(green, torch.tensor([0.0, 1, 0]), atol=1e-6, rtol=0)
    back = simclr.rotate_hue(simclr.rotate_hue(images, angle), -angle)
    torch.testing.assert_close(back, images, atol=1e-5, rtol=0)
    torch.testing.assert_close(simclr.rotate_hue(colourless, angle), colourless, atol=1e-5, rtol=0)


def test_jitter_without_strength_is_nothing_brightness_scales_saturation_leaves_the_luminance(images):
    images = 0.3 + 0.4 * images
    torch.testing.assert_close(simclr.jitter(images, STILL, drawn()), images, atol=1e-5, rtol=0)
    gain = simclr.jitter(images, STILL.model_copy(update={"brightness": 0.2}), drawn()) / images
    torch.testing.assert_close(gain, gain[:, :1, :1, :1].expand_as(gain), atol=1e-5, rtol=0)
    assert gain.min() >= 0.8 and gain.max() <= 1.2
    pale = simclr.jitter(images, STILL.model_copy(update={"saturation": 0.3}), drawn())
    torch.testing.assert_close(simclr.grey(pale), simclr.grey(images), atol=1e-5, rtol=0)
    assert not torch.allclose(pale, images, atol=1e-3)


def test_blur_keeps_a_flat_image_and_a_dot_becomes_the_gaussian():
    flat = torch.full((2, 3, 9, 11), 0.4)
    torch.testing.assert_close(simclr.blur(flat, (0.5, 2.0), drawn()), flat)
    dot = torch.zeros(1, 3, 15, 15)
    dot[..., 7, 7] = 1
    x = torch.arange(-7, 8).float()
    bell = torch.where(x.abs() <= 3, (-0.5 * x.square()).exp(), 0.0)
    spread = simclr.blur(dot, (1.0, 1.0), drawn())[0, 0]
    torch.testing.assert_close(spread, torch.outer(bell, bell) / bell.sum() ** 2, atol=1e-6, rtol=0)


@pytest.fixture(scope="module")
def physics() -> Derenderer:
    return Derenderer.from_preset("small", seed=0, image_size=32, width=8, light_width=4).eval()


def config(objective: simclr.SimclrObjective) -> simclr.SimclrConfig:
    return simclr.SimclrConfig(model=TINY, objective=objective)


def test_the_loss_is_nt_xent_of_the_projections(seeded, losses):
    net, images = seeded(simclr.Simclr, TINY), torch.rand(5, 3, 32, 32)
    noisy = lambda images, generator: images + torch.rand(images.shape, generator=generator) / 4  # noqa: E731
    terms = losses(net, images, config(simclr.SimclrObjective(temperature=0.2)), 3, noisy)
    generator = drawn(3)
    views = [noisy(images, generator), noisy(images, generator)]
    codes = torch.cat([net.head(net.encoder(view)) for view in views])
    oracle = NTXentLoss(temperature=0.2)(codes, torch.arange(5).repeat(2))
    torch.testing.assert_close(terms["nt_xent"], oracle)


def test_physical_views_without_any_change_are_the_reconstruction(physics):
    images = torch.rand(3, 3, 32, 32, generator=drawn())
    still = PerturbSettings(ambient=0, diffuse=0, light_deg=0, camera_pitch_deg=0, camera_yaw_deg=0)
    rendering, view = physics.reconstruct(images), simclr.physical_view(physics, images, still, drawn())
    seen = rendering.mask[:, None].expand_as(view) > 0
    torch.testing.assert_close(view[seen], rendering.image.clamp(0, 1)[seen], atol=1e-5, rtol=1e-4)


def test_physical_views_change_light_and_camera_and_nothing_else(physics, monkeypatch):
    images, asked, render = torch.rand(4, 3, 32, 32, generator=drawn()), [], physics.render
    monkeypatch.setattr(physics, "render", lambda scene: asked.append(scene) or render(scene))
    first, second = (simclr.physical_view(physics, images, PerturbSettings(), drawn(seed)) for seed in (0, 1))
    scene = physics.decompose(images)
    assert len(asked) == 2
    for changed in asked:
        torch.testing.assert_close(changed.depth, scene.depth)
        torch.testing.assert_close(changed.albedo, scene.albedo)
        assert not torch.isclose(changed.light, scene.light).any()
        assert not torch.isclose(changed.camera[:, :2], scene.camera[:, :2]).any()
        torch.testing.assert_close(changed.camera[:, 2:], scene.camera[:, 2:])
    assert not torch.equal(first, second) and first.min() >= 0 and first.max() <= 1


def test_physical_views_need_a_model_of_that_size(physics, tmp_path):
    cpu = torch.device("cpu")
    for wrong in ({"views": "physical"}, {"physics": "runs/x"}):
        with pytest.raises(ValueError, match="views=physical and physics=RUN"):
            simclr.SimclrObjective(**wrong)
    saved = simclr.SimclrObjective(views="physical", physics=str(physics.save(tmp_path / "physics")))
    with pytest.raises(ValueError, match="takes images of 32 pixels, this run of 64: set image_size=32"):
        simclr.views_of(simclr.SimclrConfig(objective=saved), cpu)
    images = torch.rand(2, 3, 32, 32)
    expected = simclr.physical_view(physics, images, saved.perturb, drawn(5))
    torch.testing.assert_close(simclr.views_of(config(saved), cpu)(images, drawn(5)), expected)
