"""Augmentations obey the laws of what they claim to do."""

import math

import pytest
import torch

from derender.baselines.augment import (
    LUMINANCE,
    AugmentSettings,
    augment,
    blur,
    crop,
    grey,
    jitter,
    rotate_hue,
    where,
)

OFF = AugmentSettings(crop_from=1.0, aspect=1.0, flip=0, jitter=0, grey=0, blur=0)


@pytest.fixture
def images() -> torch.Tensor:
    return torch.rand(6, 3, 20, 24, generator=torch.Generator().manual_seed(1))


def drawn(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_everything_off_is_the_picture(images):
    torch.testing.assert_close(augment(images, OFF, drawn()), images)


def test_views_stay_in_range_repeat_for_a_generator_and_differ_between_pictures(images):
    first, again, other = (augment(images, AugmentSettings(), drawn(seed)) for seed in (0, 0, 1))
    assert torch.equal(first, again) and not torch.equal(first, other)
    assert first.shape == images.shape and 0 <= first.min() <= first.max() <= 1
    same = images[:1].expand(6, -1, -1, -1)
    views = augment(same, AugmentSettings(), drawn())
    assert all(not torch.equal(views[0], views[i]) for i in range(1, 6))


def test_a_flip_is_certain_or_never_and_its_own_inverse(images):
    flipped = augment(images, OFF.model_copy(update={"flip": 1.0}), drawn())
    torch.testing.assert_close(flipped, images.flip(-1))
    torch.testing.assert_close(augment(flipped, OFF.model_copy(update={"flip": 1.0}), drawn()), images)
    half = where(0.5, torch.ones(2000, 3, 1, 1), torch.zeros(2000, 3, 1, 1), drawn())
    assert 0.46 < half[:, 0].mean() < 0.54


def test_a_crop_lies_inside_the_picture(images):
    """A frame of another colour, wider than the border, is seen by whatever reaches beyond."""
    small = AugmentSettings(crop_from=0.1)
    for seed in range(20):
        ramp = torch.linspace(0, 1, 24).expand(50, 3, 20, 24)
        part = crop(ramp, small, drawn(seed))
        assert part.min() >= 0 and part.max() <= 1
        widths = part[:, 0, 0, -1] - part[:, 0, 0, 0]
        assert widths.min() > math.sqrt(0.1 * 0.75) - 2 / 24 and widths.max() <= 1
        assert (part[:, 0, 0].diff(dim=1) >= -1e-6).all()


def test_grey_has_three_equal_channels_and_the_luminance(images):
    colourless = grey(images)
    assert torch.equal(colourless[:, 0], colourless[:, 1]) and torch.equal(colourless[:, 0], colourless[:, 2])
    torch.testing.assert_close(colourless[:, 0], sum(w * images[:, i] for i, w in enumerate(LUMINANCE)))
    torch.testing.assert_close(grey(colourless), colourless)


def test_hue_turns_red_to_green_to_blue_and_leaves_grey(images):
    red = torch.tensor([1.0, 0, 0]).view(1, 3, 1, 1)
    third = torch.tensor([2 * math.pi / 3])
    torch.testing.assert_close(rotate_hue(red, third).flatten(), torch.tensor([0.0, 1, 0]), atol=1e-6, rtol=0)
    angle = torch.full((6,), 0.7)
    torch.testing.assert_close(rotate_hue(rotate_hue(images, angle), -angle), images, atol=1e-5, rtol=0)
    colourless = grey(images)
    torch.testing.assert_close(rotate_hue(colourless, angle), colourless, atol=1e-5, rtol=0)


def test_jitter_without_strength_changes_nothing(images):
    still = AugmentSettings(brightness=0, contrast=0, saturation=0, hue_deg=0)
    torch.testing.assert_close(jitter(images, still, drawn()), images, atol=1e-5, rtol=0)


def test_saturation_leaves_the_luminance_and_brightness_scales(images):
    images = 0.3 + 0.4 * images
    dim = jitter(images, AugmentSettings(brightness=0.2, contrast=0, saturation=0, hue_deg=0), drawn())
    gain = dim / images
    torch.testing.assert_close(gain, gain[:, :1, :1, :1].expand_as(gain), atol=1e-5, rtol=0)
    assert gain.min() >= 0.8 and gain.max() <= 1.2
    pale = jitter(images, AugmentSettings(brightness=0, contrast=0, saturation=0.3, hue_deg=0), drawn())
    torch.testing.assert_close(grey(pale), grey(images), atol=1e-5, rtol=0)
    assert not torch.allclose(pale, images, atol=1e-3)


def test_blur_keeps_a_flat_picture_and_a_dot_becomes_the_gaussian():
    flat = torch.full((2, 3, 9, 11), 0.4)
    torch.testing.assert_close(blur(flat, (0.5, 2.0), drawn()), flat)
    dot = torch.zeros(1, 3, 15, 15)
    dot[..., 7, 7] = 1
    spread = blur(dot, (1.0, 1.0), drawn())[0, 0]
    x = torch.arange(-7, 8).float()
    bell = torch.where(x.abs() <= 3, (-0.5 * x.square()).exp(), 0.0)
    torch.testing.assert_close(spread, torch.outer(bell, bell) / bell.sum() ** 2, atol=1e-6, rtol=0)
