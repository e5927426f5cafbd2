"""Perturbations stay physical, are uniform, and touch only the factor that each image chose."""

import math
from collections import Counter

import pytest
import torch
from torch import Generator

from derender.scene import perturb as perturbing
from derender.scene.perturb import PerturbSettings, choose_factors, exchange, perturb_camera, perturb_light
from derender.scene.ranges import SceneRanges

MANY = 20_000
QUARTER = math.radians(45)
LIMIT = math.radians(60)


def seeded(seed: int) -> Generator:
    return Generator().manual_seed(seed)


def uniform_between(values: torch.Tensor, low: float, high: float) -> bool:
    """Whether the Kolmogorov-Smirnov distance to the uniform law, times sqrt(n), is below 1.95: p = 0.001."""
    ordered = ((values.double() - low) / (high - low)).sort().values
    expected = (torch.arange(len(ordered), dtype=torch.float64) + 0.5) / len(ordered)
    return ((ordered - expected).abs().max() * math.sqrt(len(ordered))).item() < 1.95


@pytest.mark.parametrize(
    ("light", "ends"),
    [
        ([0.5, 0.5, 0.0, 0.0], [(0, 1), (0, 1), (-QUARTER, QUARTER), (-QUARTER, QUARTER)]),
        ([1.0, 0.0, QUARTER, -QUARTER], [(0.5, 1.0), (0.0, 0.5), (0.0, QUARTER), (-QUARTER, 0.0)]),
        ([1.4, -3.0, 2.0, -2.0], [(0.5, 1.0), (0.0, 0.5), (0.0, QUARTER), (-QUARTER, 0.0)]),
    ],
    ids=["the paper's ranges", "at a bound", "beyond its bounds"],
)
def test_light_is_uniform_over_what_is_physical(light, ends, generator):
    result = perturb_light(torch.tensor(light).expand(MANY, 4), generator)
    assert all(uniform_between(result[:, column], *end) for column, end in enumerate(ends))
    correlation = torch.corrcoef(result.T) - torch.eye(4)
    assert correlation.abs().max() < 4 / math.sqrt(MANY), "the four numbers must be drawn by themselves"


def test_camera_is_uniform_in_pitch_and_yaw_and_untouched_elsewhere(generator):
    camera = torch.tensor([0.0, 0.0, 0.3, 0.01, -0.02, 0.0]).expand(MANY, 6)
    result = perturb_camera(camera, generator)
    assert uniform_between(result[:, 0], -QUARTER / 2, QUARTER / 2)
    assert uniform_between(result[:, 1], -QUARTER, QUARTER)
    assert torch.equal(result[:, 2:], camera[:, 2:])
    turned = perturb_camera(torch.tensor([LIMIT, -LIMIT, 0, 0, 0, 0]).expand(MANY, 6), generator)
    assert uniform_between(turned[:, 0], LIMIT - QUARTER / 2, LIMIT)
    assert uniform_between(turned[:, 1], -LIMIT, -LIMIT + QUARTER)


def test_bounds_come_from_the_scene_ranges_and_sizes_from_the_settings(generator):
    cars = SceneRanges(diffuse=(0.5, 1.0), light_deg=20.0, rotation_deg=10.0)
    start = torch.tensor([0.5, 0.75, 0.0, 0.0]).expand(MANY, 4)
    light = perturb_light(start, generator, PerturbSettings(), cars)
    assert uniform_between(light[:, 1], 0.5, 1.0)
    assert light[:, 2:].abs().max() <= math.radians(20) + 1e-6
    camera = perturb_camera(torch.zeros(MANY, 6), generator, PerturbSettings(), cars)
    assert camera[:, 1].abs().max() <= math.radians(10) + 1e-6
    small = PerturbSettings(ambient=0.1, diffuse=0.0, light_deg=0.0, camera_pitch_deg=0.0, camera_yaw_deg=5.0)
    start = torch.tensor([0.5, 0.4, 0.1, -0.2]).expand(MANY, 4)
    result = perturb_light(start, generator, small)
    assert uniform_between(result[:, 0], 0.4, 0.6)
    torch.testing.assert_close(result[:, 1:], start[:, 1:])
    turned = perturb_camera(torch.zeros(MANY, 6), generator, small)
    assert torch.equal(turned[:, 0], torch.zeros(MANY))
    assert uniform_between(turned[:, 1], -math.radians(5), math.radians(5))


def test_the_perturbed_value_keeps_its_gradient():
    light = torch.tensor([[0.5, 0.5, 0.0, 0.0]], requires_grad=True)
    small, loose = PerturbSettings(ambient=0.2, diffuse=0.2, light_deg=20.0), SceneRanges(light_deg=89.0)
    perturb_light(light, seeded(0), small, loose).sum().backward()
    torch.testing.assert_close(light.grad, torch.ones(1, 4))


@pytest.mark.parametrize("perturb", [perturb_light, perturb_camera, exchange])
def test_the_generator_alone_decides(perturb):
    value = torch.rand(8, 6 if perturb is perturb_camera else 4, generator=seeded(9)) / 2
    torch.manual_seed(0)
    one = perturb(value, seeded(1))
    torch.manual_seed(1)
    assert torch.equal(perturb(value, seeded(1)), one)
    assert not torch.equal(perturb(value, seeded(2)), one)


def test_derangements_fix_nothing_and_are_uniform(generator):
    counts = Counter(tuple(perturbing.derangement(4, generator).tolist()) for _ in range(4500))
    assert len(counts) == 9
    for order in counts:
        assert sorted(order) == [0, 1, 2, 3] and all(i != place for i, place in enumerate(order))
    chi_squared = sum((count - 500) ** 2 / 500 for count in counts.values())
    assert chi_squared < 26.1, "8 degrees of freedom, p = 0.001"


def test_two_images_swap_and_one_is_refused(generator):
    value = torch.arange(6.0).view(2, 3)
    assert torch.equal(exchange(value, generator), value.flip(0))
    with pytest.raises(ValueError, match="at least 2"):
        exchange(value[:1], generator)


def test_factors_are_chosen_uniformly_and_per_image(generator):
    chosen = choose_factors(MANY, (2, 3), generator)
    assert set(chosen.tolist()) == {2, 3}
    for share in ((chosen == 2).float().mean(), (chosen[1:] == chosen[:-1]).float().mean()):
        assert abs(share.item() - 0.5) < 4 * 0.5 / math.sqrt(MANY)
    with pytest.raises(ValueError, match="no factor to choose"):
        choose_factors(3, (), generator)
