"""The autoencoders have our geometry net's size; the VAE's divergence and sampling are the normal ones."""

from contextlib import nullcontext

import pytest
import torch
from torch.distributions import Normal, kl_divergence

from derender.baselines.autoencoder import (
    Autoencoder,
    AutoencoderConfig,
    AutoencoderSettings,
    BetaObjective,
    BetaVae,
    BetaVaeConfig,
    kl_to_standard_normal,
)
from derender.baselines.model import LossInputs
from derender.model import Derenderer
from derender.presets import ModelSettings

TINY = AutoencoderSettings(image_size=32, width=8, code_size=16)


def test_the_plain_one_has_the_parameters_of_our_albedo_net():
    with torch.device("meta"):
        model, ours = Autoencoder(AutoencoderSettings()), Derenderer(ModelSettings())
    count = sum(value.numel() for value in model.parameters())
    assert count == 12_982_848 == sum(value.numel() for value in ours.nets["albedo"].parameters())


def test_the_divergence_is_the_normal_one():
    mean, log_variance = torch.randn(5, 3), torch.randn(5, 3)
    expected = kl_divergence(Normal(mean, (log_variance / 2).exp()), Normal(0.0, 1.0))
    torch.testing.assert_close(kl_to_standard_normal(mean, log_variance), expected)
    assert not kl_to_standard_normal(torch.zeros(2, 3), torch.zeros(2, 3)).any()


def test_the_vae_samples_in_training_and_takes_the_mean_otherwise():
    torch.manual_seed(0)
    model, images = BetaVae(TINY), torch.rand(4, 3, 32, 32)

    def l1(seed: int) -> float:
        generator = torch.Generator().manual_seed(seed)
        return model.losses(images, LossInputs(BetaVaeConfig(), generator, nullcontext))["l1"].item()

    model.train()
    assert l1(0) == l1(0) != l1(1)
    model.eval()
    assert l1(0) == l1(1)
    shown = model.shown(images, None)["reconstruction"]
    assert l1(0) == pytest.approx((shown - images).abs().mean().item(), rel=1e-5)
    mean = model.embed(images)["mean"]
    assert mean.shape == (4, 16) and (mean < 0).any()


def test_beta_scales_the_divergence_and_nothing_else():
    torch.manual_seed(0)
    model, images = BetaVae(TINY).eval(), torch.rand(4, 3, 32, 32)
    one, four = (
        model.losses(
            images,
            LossInputs(BetaVaeConfig(objective=BetaObjective(beta=beta)), torch.Generator(), nullcontext),
        )
        for beta in (1.0, 4.0)
    )
    torch.testing.assert_close(four["kl"], 4 * one["kl"])
    torch.testing.assert_close(four["reconstruction"], one["reconstruction"])
    mean, log_variance = model.posterior(images)
    expected = kl_to_standard_normal(mean, log_variance).sum() / images.numel()
    torch.testing.assert_close(one["kl"], expected)


def test_a_reconstruction_lies_in_range_and_its_error_is_the_mean_square():
    torch.manual_seed(0)
    model, images = Autoencoder(TINY).eval(), torch.rand(4, 3, 32, 32)
    again = model.reconstruct(images)
    assert 0 <= again.min() <= again.max() <= 1
    terms = model.losses(images, LossInputs(AutoencoderConfig(), torch.Generator(), nullcontext))
    torch.testing.assert_close(terms["reconstruction"], (again - images).square().mean())
    assert model.embed(images)["code"].min() >= 0


def test_sizes_are_those_of_our_networks():
    with pytest.raises(ValueError, match="image_size must be one of 32, 64, 128, 256, got 48"):
        AutoencoderSettings(image_size=48)
