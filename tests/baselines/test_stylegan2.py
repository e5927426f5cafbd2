"""What each network of a StyleGAN2 is moved by, its regularisers, and how held-out images judge it."""

import pytest
import torch
from torch import nn

from derender.baselines import stylegan2
from derender.baselines.generator import GeneratorSettings

TINY = GeneratorSettings(image_size=8, style_size=6, mapping_layers=2, channel_base=32, channel_max=6)


def config(**objective) -> stylegan2.StyleganConfig:
    return stylegan2.StyleganConfig(objective=stylegan2.AdversarialObjective(**objective))


@pytest.fixture
def model(seeded):
    return seeded(stylegan2.Stylegan, TINY).train()


@pytest.fixture
def images(generator):
    return torch.rand(4, 3, 8, 8, generator=generator)


def test_each_loss_moves_its_own_network(model, images, generator, losses):
    terms = losses(model, images, config(), generator)
    assert set(terms) == {"generator", "discriminator", "r1", "path"}  # the first step has both regularisers
    for name, term in terms.items():
        model.zero_grad()
        term.backward(retain_graph=True)
        moved = model.learner if name in ("generator", "path") else model.discriminator
        for net in (model.learner, model.discriminator):
            touched = any(value.grad is not None and value.grad.any() for value in net.parameters())
            assert touched == (net is moved), name
    assert not any(value.requires_grad for value in model.generator.parameters())
    assert set(losses(model, images, config(), generator)) == {"generator", "discriminator"}


def test_r1_of_a_linear_score_is_half_its_squared_slope(generator):
    score = nn.Sequential(nn.Flatten(), nn.Linear(12, 1), nn.Flatten(0))
    result = stylegan2.r1_penalty(score, torch.rand(5, 3, 2, 2, generator=generator))
    torch.testing.assert_close(result, score[1].weight.square().sum() / 2)


def test_path_lengths_are_those_of_the_jacobian(model, generator):
    """One column for each number of W+, by central differences of the images."""
    net, w = model.learner.double(), torch.randn(2, TINY.codes, 6, generator=generator, dtype=torch.float64)
    state = generator.get_state()
    result = stylegan2.path_lengths(net, w, generator)
    generator.set_state(state)
    noise = net.random_noise(2, generator)
    direction = torch.randn(2, 3, 8, 8, generator=generator).double() / 8
    numbers = TINY.codes * 6
    steps = 1e-5 * torch.eye(numbers, dtype=torch.float64).reshape(numbers, TINY.codes, 6)
    with torch.no_grad():
        for one in range(2):
            here = [level[one : one + 1] for level in noise]
            after, before = (net(w[one] + sign * steps, here) for sign in (1, -1))
            pulled = ((after - before) / 2e-5 * direction[one]).sum(dim=(1, 2, 3))
            wanted = (pulled.square().sum() / TINY.codes).sqrt()
            torch.testing.assert_close(result[one].detach(), wanted, rtol=1e-6, atol=0.0)


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
    assert stylegan2.energy_distance(first, second).abs() < 0.02
    assert stylegan2.energy_distance(first, second + 1) > 0.2
    assert stylegan2.energy_distance(torch.zeros(2, 1), torch.full((2, 1), 3.0)) == 6
    assert stylegan2.energy_distance(first[:1], second) == 0  # one image says nothing


def test_held_out_images_are_judged_by_samples_of_the_average(model, images, losses):
    assert set(losses(model.eval(), images, config())) == {"energy"} and model.steps == 0
    whole, again = (model.sample(3, torch.Generator().manual_seed(5)) for _ in range(2))
    assert whole.shape == (3, 3, 8, 8) and whole.min() >= 0 and whole.max() <= 1
    assert torch.equal(whole, again)
    assert [column.shape for column in model.shown(whole).values()] == 7 * [whole.shape]


def test_features_of_the_discriminator_do_not_see_the_batch_but_scores_see_their_group(seeded, generator):
    settings = GeneratorSettings(image_size=16, style_size=12, channel_base=128, channel_max=10)
    net = seeded(stylegan2.Discriminator, settings).requires_grad_(False)
    images = torch.randn(8, 3, 16, 16, generator=generator)
    torch.testing.assert_close(net.describe(images)[2:3], net.describe(images[2:3]), rtol=1e-4, atol=1e-5)
    changed = images.clone()
    changed[1] += 1
    differ = (net(images) - net(changed)).abs() > 1e-6
    assert differ.tolist() == [False, True] * 4  # image i is compared with those equal to i modulo 2
