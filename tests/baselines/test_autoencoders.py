"""Autoencoders have our albedo net's size, VAEs the normal divergence; the VQ-VAE keeps its codebook used."""

import pytest
import torch
from torch.distributions import Normal, kl_divergence

from derender.baselines import autoencoders as ae
from derender.model import Derenderer
from derender.presets import ModelSettings

SMALL = ae.AutoencoderSettings(image_size=32, width=8, code_size=16)
TINY = ae.VqvaeSettings(image_size=32, width=8, codes=16)
IMAGES = torch.rand(6, 3, 32, 32, generator=torch.Generator().manual_seed(0))


def test_parameters_are_those_of_our_albedo_net_and_of_the_papers_two_readings():
    with torch.device("meta"):
        plain, ours = ae.Autoencoder(ae.AutoencoderSettings()), Derenderer(ModelSettings()).nets["albedo"]
        wide, narrow = (ae.Vqvae(ae.VqvaeSettings(width=width)) for width in (512, 416))
    learnt = [[x for x in net.parameters() if x.requires_grad] for net in (plain, ours, wide, narrow)]
    counts = [sum(map(torch.numel, values)) for values in learnt]
    assert counts == [12_982_848, 12_982_848, 19_199_491, 12_724_195]
    assert [tuple(value.shape) for value in wide.codebook.parameters()] == [(1, 512, 512)]
    with pytest.raises(ValueError, match="image_size must be one of 32, 64, 128, 256, got 48"):
        ae.AutoencoderSettings(image_size=48)


def test_a_reconstruction_lies_in_range_and_its_error_is_the_mean_square(seeded, losses):
    model = seeded(ae.Autoencoder, SMALL).eval()
    again = model.shown(IMAGES)["reconstruction"]
    assert 0 <= again.min() <= again.max() <= 1
    terms = losses(model, IMAGES, ae.AutoencoderConfig())
    torch.testing.assert_close(terms["reconstruction"], (again - IMAGES).square().mean())
    assert model.embed(IMAGES)["code"].min() >= 0


def test_the_vae_samples_in_training_and_takes_the_mean_otherwise(seeded, losses):
    model = seeded(ae.BetaVae, SMALL).train()
    one, again, other = (losses(model, IMAGES, ae.BetaVaeConfig(), seed)["l1"].item() for seed in (0, 0, 1))
    assert one == again != other
    model.eval()
    one, other = (losses(model, IMAGES, ae.BetaVaeConfig(), seed)["l1"].item() for seed in (0, 1))
    assert one == other
    shown = model.shown(IMAGES)["reconstruction"]
    assert one == pytest.approx((shown - IMAGES).abs().mean().item(), rel=1e-5)
    mean = model.embed(IMAGES)["mean"]
    assert mean.shape == (6, 16) and (mean < 0).any()


def test_beta_scales_the_normal_divergence_and_nothing_else(seeded, losses):
    model = seeded(ae.BetaVae, SMALL).eval()
    configs = [ae.BetaVaeConfig(objective=ae.BetaObjective(beta=by)) for by in (1.0, 4.0)]
    one, four = (losses(model, IMAGES, config) for config in configs)
    torch.testing.assert_close(four["kl"], 4 * one["kl"])
    torch.testing.assert_close(four["reconstruction"], one["reconstruction"])
    mean, log_variance = model.posterior(IMAGES)
    expected = kl_divergence(Normal(mean, (log_variance / 2).exp()), Normal(0.0, 1.0)).sum() / IMAGES.numel()
    torch.testing.assert_close(one["kl"], expected)


def test_every_place_gets_the_nearest_entry_and_gradients_go_their_two_ways(seeded, losses):
    model = seeded(ae.Vqvae, TINY)
    losses(model, IMAGES, ae.VqvaeConfig())  # k-means starts the codebook
    model.eval()
    grid = torch.randn(2, 8, 5, 5, requires_grad=True)
    through, result, indices = model.quantise(grid)
    entries, flat = model.codebook.codebook, grid.detach().permute(0, 2, 3, 1).reshape(-1, 8)
    assert torch.equal(indices.flatten(), torch.cdist(flat, entries.detach()).argmin(dim=1))
    torch.testing.assert_close(through, result)
    torch.testing.assert_close(result[1, :, 2, 3], entries[indices[1, 2, 3]])

    model.train()
    through, result, indices = model.quantise(grid)
    cotangent, stored = torch.randn(2, 8, 5, 5), model.codebook._codebook.embed
    kept = {"allow_unused": True, "retain_graph": True}
    to_grid, to_codebook = torch.autograd.grad((through * cotangent).sum(), [grid, stored], **kept)
    torch.testing.assert_close(to_grid, cotangent)
    assert to_codebook is None or not to_codebook.any()
    (to_codebook,) = torch.autograd.grad((result * cotangent).sum(), [stored])
    rows = cotangent.permute(0, 2, 3, 1).reshape(-1, 8)
    torch.testing.assert_close(to_codebook[0], torch.zeros(16, 8).index_add_(0, indices.flatten(), rows))


def test_the_three_losses_are_those_of_the_source(seeded, losses):
    model = seeded(ae.Vqvae, TINY).train()
    losses(model, IMAGES, ae.VqvaeConfig())
    before = {name: value.clone() for name, value in model.state_dict().items()}
    terms = losses(model, IMAGES, ae.VqvaeConfig())
    model.load_state_dict(before)
    grid = model.encode(IMAGES)
    through, entries, indices = model.quantise(grid)
    gap = (entries - grid).square().mean()
    torch.testing.assert_close(terms["codebook"], gap)
    torch.testing.assert_close(terms["commitment"], 0.25 * gap)
    torch.testing.assert_close(terms["reconstruction"], 4 * (model.decode(through) - IMAGES).square().mean())
    share = torch.bincount(indices.flatten()) / indices.numel()
    entropy = -sum(float(part * part.log()) for part in share if part)
    assert terms["codes_used"].log().item() == pytest.approx(entropy, abs=1e-4)


def test_training_lowers_the_error_and_keeps_the_codebook_in_use(blobs, seeded, losses):
    model, images = seeded(ae.Vqvae, TINY).train(), torch.from_numpy(blobs.images[:16]).float() / 255
    optimiser, generator = torch.optim.Adam(model.parameters(), 3e-3), torch.Generator().manual_seed(0)
    history = []
    for _ in range(40):
        terms = losses(model, images, ae.VqvaeConfig(), generator)
        optimiser.zero_grad()
        (terms["reconstruction"] + terms["codebook"] + terms["commitment"]).backward()
        optimiser.step()
        history.append(terms["reconstruction"].item())
    assert history[-1] < 0.4 * history[0] and terms["codes_used"] > 6


def test_features_are_the_map_its_mean_and_its_histogram(seeded, losses):
    model = seeded(ae.Vqvae, TINY)
    losses(model, IMAGES, ae.VqvaeConfig())
    model.eval()
    assert list(model.embed(IMAGES)) == ["pooled"]
    model.choose(("histogram", "map", "pooled"))
    features = model.embed(IMAGES)
    assert [tuple(value.shape) for value in features.values()] == [(6, 16), (6, 8 * 8 * 8), (6, 8)]
    torch.testing.assert_close(features["pooled"], features["map"].view(6, 8, 64).mean(dim=2))
    torch.testing.assert_close(features["pooled"], features["histogram"] @ model.codebook.codebook)
    features["pooled"].square().sum().backward()
    assert model.encoder[0].weight.grad is not None and model.encoder[0].weight.grad.any()  # fine-tuned, too
    unknown = "unknown feature of vqvae 'poold'; did you mean 'pooled'"
    for names, message in ((("poold",), unknown), ((), "unknown feature")):
        with pytest.raises(ValueError, match=message):
            model.choose(names)
    with pytest.raises(ValueError, match=r"takes images of shape \(N, 3, 32, 32\), got \(1, 3, 16, 16\)"):
        model.embed(torch.rand(1, 3, 16, 16))
