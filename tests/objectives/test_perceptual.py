"""The perceptual loss at a resolution of its own, and what every frozen feature extractor promises.

What it has in common with the photometric loss is in test_reconstruction.py.
"""

import pytest
import torch
from torch import nn

from derender.objectives.perceptual import PerceptualFeatures, perceptual_loss
from derender.training import resolve
from derender.training.derender_task import perceptual_of
from derender.training.run_folder import RunFolder


class Tiny(PerceptualFeatures):
    """Two random convolutions at half resolution."""

    stride, channels = 2, 4

    def __init__(self, generator: torch.Generator):
        layers = nn.Sequential(nn.Conv2d(3, 4, 3, padding=1), nn.ReLU(), nn.AvgPool2d(2))
        nn.init.normal_(layers[0].weight, generator=generator)
        nn.init.zeros_(layers[0].bias)
        super().__init__(layers, (0.5, 0.4, 0.3), (0.2, 0.3, 0.4))


def test_a_location_counts_by_the_share_of_its_pixels_that_the_mask_keeps():
    prediction = torch.zeros(1, 2, 1, 3, dtype=torch.float64)
    target = torch.tensor([1.0, 2.0, 5.0], dtype=torch.float64).expand(1, 2, 1, 3)
    mask = torch.zeros(1, 4, 12, dtype=torch.float64)
    mask[0, :, :4] = 1  # all of the first location
    mask[0, :2, 4:8] = 1  # half of the second, none of the third
    expected = (1 * 1 + 0.5 * 4) / 1.5
    assert perceptual_loss(prediction, target, mask, None).item() == pytest.approx(expected)
    assert perceptual_loss(prediction, target, mask.bool(), None).item() == pytest.approx(expected)


def test_every_picture_has_a_mask_of_its_own(generator):
    prediction, target = torch.rand(2, 2, 5, 4, 4, generator=generator)
    sigma = 0.3 + torch.rand(2, 1, 4, 4, generator=generator)
    mask = torch.zeros(2, 4, 4)
    mask[0, :, :2], mask[1, :, 1:] = 1, 1
    each = [perceptual_loss(*(one[n : n + 1] for one in (prediction, target, mask, sigma))) for n in (0, 1)]
    together = perceptual_loss(prediction, target, mask, sigma)
    assert together.item() == pytest.approx((8 * each[0] + 12 * each[1]).item() / 20, rel=1e-5)


def test_sigma_of_another_resolution_is_refused(generator):
    features = torch.randn(2, 2, 5, 3, 4, generator=generator)
    with pytest.raises(ValueError, match="resolution 3 x 4"):
        perceptual_loss(*features, torch.ones(2, 12, 16), torch.ones(2, 1, 6, 8))


def test_features_are_normalised_pictures_through_the_layers(generator):
    net = Tiny(generator)
    images = torch.rand(2, 3, 6, 8, generator=generator)
    channels = enumerate([(0.5, 0.2), (0.4, 0.3), (0.3, 0.4)])
    normalised = torch.stack([(images[:, c] - mean) / std for c, (mean, std) in channels], 1)
    torch.testing.assert_close(net(images), net.features(normalised))


def test_calibration_makes_the_spread_one_and_keeps_relations(generator):
    net = Tiny(generator)
    images = torch.rand(70, 3, 6, 8, generator=generator)
    before = net(images)
    net.calibrate_(images)
    after = net(images)
    spread = (after - after.mean(dim=(0, 2, 3), keepdim=True)).square().mean().sqrt()
    assert spread.item() == pytest.approx(1, rel=1e-5)
    torch.testing.assert_close(after / after.max(), before / before.max())
    again = net.scale.clone()
    assert torch.equal(net.calibrate_(images).scale, again)
    assert "scale" in net.state_dict()


def test_calibration_on_pictures_that_do_not_differ_is_refused(generator):
    net = Tiny(generator)
    net.features[0].bias.fill_(-1e3)
    with pytest.raises(ValueError, match="do not vary over 2 calibration images"):
        net.calibrate_(torch.rand(2, 3, 6, 8, generator=generator))


def test_frozen_whatever_the_model_around_does(generator):
    whole = nn.Sequential(Tiny(generator))
    whole.train()
    assert not whole[0].training and not whole[0].features.training
    assert not any(parameter.requires_grad for parameter in whole.parameters())
    images = torch.rand(1, 3, 6, 8, generator=generator, requires_grad=True)
    (gradient,) = torch.autograd.grad(whole[0](images).sum(), images)
    assert gradient.abs().sum() > 0


def test_vgg_is_calibrated_on_the_first_256_pictures_or_keeps_scale_1(monkeypatch, tmp_path):
    def weights(_: object) -> Tiny:
        return Tiny(torch.Generator().manual_seed(3))

    monkeypatch.setattr("derender.training.derender_task.load_vgg16", weights)
    images = (torch.rand(258, 3, 6, 8, generator=torch.Generator().manual_seed(0)) * 255).byte()
    expected = weights(None).calibrate_(images[:256].float() / 255).scale
    for rescaled, scale in ((True, expected), (False, torch.ones(()))):
        config = resolve("small", ["perceptual=vgg16", f"perceptual_rescaled={str(rescaled).lower()}"])
        made = perceptual_of(config, RunFolder(tmp_path), images, lambda done, total: None)
        assert torch.equal(made.scale, scale)
