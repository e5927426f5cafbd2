"""What each network of a StyleGAN2 is moved by, its regularisers, and how held-out images judge it."""

from contextlib import nullcontext

import pytest
import torch
from torch import nn

from derender.baselines.model import LossInputs
from derender.baselines.stylegan2 import (
    AdversarialObjective,
    Stylegan,
    StyleganConfig,
    energy_distance,
    mixed_w,
    path_lengths,
    path_penalty,
    r1_penalty,
    r1_weight_of,
)
from derender.baselines.stylegan2_generator import GeneratorSettings

TINY = GeneratorSettings(image_size=8, style_size=6, mapping_layers=2, channel_base=32, channel_max=6)


def losses(model, images, objective, generator):
    return model.losses(images, LossInputs(StyleganConfig(objective=objective), generator, nullcontext))


@pytest.fixture
def model():
    torch.manual_seed(0)
    return Stylegan(TINY).train()


def test_each_loss_moves_its_own_network(model, generator):
    images = torch.rand(4, 3, 8, 8, generator=generator)
    terms = losses(model, images, AdversarialObjective(), generator)
    assert set(terms) == {"generator", "discriminator", "r1", "path"}  # the first step has both regularisers
    moved = {
        "generator": model.learner, "path": model.learner,
        "discriminator": model.discriminator, "r1": model.discriminator,
    }  # fmt: skip
    for name, term in terms.items():
        model.zero_grad()
        term.backward(retain_graph=True)
        for net in (model.learner, model.discriminator):
            touched = any(value.grad is not None and value.grad.any() for value in net.parameters())
            assert touched == (net is moved[name]), name
    assert not any(value.requires_grad for value in model.generator.parameters())
    again = losses(model, images, AdversarialObjective(), generator)
    assert set(again) == {"generator", "discriminator"}


def test_r1_of_a_linear_score_is_half_its_squared_slope(generator):
    score = nn.Sequential(nn.Flatten(), nn.Linear(12, 1), nn.Flatten(0))
    found = r1_penalty(score, torch.rand(5, 3, 2, 2, generator=generator))
    torch.testing.assert_close(found, score[1].weight.square().sum() / 2)


def test_r1_weighs_by_size_and_batch_unless_told(model, generator):
    by_size = AdversarialObjective()
    assert r1_weight_of(by_size, 1024, 32) == pytest.approx(6.5536)
    assert r1_weight_of(by_size, 64, 32) == pytest.approx(0.0256)
    assert r1_weight_of(AdversarialObjective(r1_weight=0.0), 64, 32) == 0
    images = torch.rand(4, 3, 8, 8, generator=generator)
    found = []
    for objective in (by_size, AdversarialObjective(r1_weight=3.0)):
        model.steps.zero_()
        found.append(losses(model, images, objective, generator)["r1"])
    torch.testing.assert_close(found[1], 3 / (2e-4 * 64 / 4) * found[0])


def test_path_lengths_are_those_of_the_jacobian(model, generator):
    """One column for each number of W+, by central differences of the images."""
    net, w = model.learner.double(), torch.randn(2, TINY.codes, 6, generator=generator, dtype=torch.float64)
    state = generator.get_state()
    found = path_lengths(net, w, generator)
    generator.set_state(state)
    noise = net.random_noise(2, generator)
    direction = torch.randn(2, 3, 8, 8, generator=generator).double() / 8
    numbers = TINY.codes * 6
    steps = 1e-5 * torch.eye(numbers, dtype=torch.float64).reshape(numbers, TINY.codes, 6)
    with torch.no_grad():
        for picture in range(2):
            here = [level[picture : picture + 1] for level in noise]
            after, before = (net(w[picture] + sign * steps, here) for sign in (1, -1))
            pulled = ((after - before) / 2e-5 * direction[picture]).sum(dim=(1, 2, 3))
            wanted = (pulled.square().sum() / TINY.codes).sqrt()
            torch.testing.assert_close(found[picture].detach(), wanted, rtol=1e-6, atol=0.0)


def test_path_penalty_moves_its_mean_towards_the_lengths(model, generator):
    objective = AdversarialObjective(path_decay=1.0)
    penalty = path_penalty(model, 2, objective, generator)
    assert model.path_length > 0 and penalty >= 0
    alone = path_penalty(model, 1, objective, generator)
    torch.testing.assert_close(alone, torch.zeros(()))  # one length is its own mean


def test_mixing_changes_the_code_at_one_depth(model, generator):
    plain = mixed_w(model.learner, 5, 0.0, generator)
    assert torch.equal(plain, plain[:, :1].expand_as(plain))
    mixed = mixed_w(model.learner, 50, 1.0, generator)
    changes = (mixed[:, 1:] != mixed[:, :-1]).any(dim=2).sum(dim=1)
    assert (changes == 1).all()


def test_the_average_follows_at_its_half_life(model):
    with torch.no_grad():
        model.learner.constant.fill_(1)
        model.generator.constant.fill_(0)
    model.steps.fill_(10_000)
    for _ in range(4):
        model.average(25, 100)
    torch.testing.assert_close(model.generator.constant, torch.full_like(model.generator.constant, 0.5))
    model.steps.fill_(0)
    model.average(25, 100)  # after one batch nearly all is the learner's
    torch.testing.assert_close(model.generator.constant, torch.ones_like(model.generator.constant))


def test_energy_distance_is_zero_for_one_distribution_only(generator):
    first, second = (torch.randn(400, 4, generator=generator) for _ in range(2))
    assert energy_distance(first, second).abs() < 0.02
    assert energy_distance(first, second + 1) > 0.2
    ends = energy_distance(torch.tensor([[0.0], [0.0]]), torch.tensor([[3.0], [3.0]]))
    assert ends == 6
    assert energy_distance(first[:1], second) == 0  # one image says nothing


def test_held_out_pictures_are_judged_by_samples_of_the_average(model, generator):
    terms = losses(
        model.eval(), torch.rand(6, 3, 8, 8, generator=generator), AdversarialObjective(), generator
    )
    assert set(terms) == {"energy"} and model.steps == 0
    samples = model.sample(3, torch.Generator().manual_seed(5))
    assert samples.shape == (3, 3, 8, 8) and samples.min() >= 0 and samples.max() <= 1
    assert torch.equal(samples, model.sample(3, torch.Generator().manual_seed(5)))
    centre = model.sample(2, generator, truncation=0.0)
    torch.testing.assert_close(centre[0], centre[1])
    assert [column.shape for column in model.shown(samples, None).values()] == 7 * [samples.shape]
