"""Perturbations stay physical, are uniform, and touch only the factor that each image chose."""

import math

import pytest
import torch
from torch import Generator

from derender.scene.perturb import (
    PerturbSettings,
    choose_factors,
    derangement,
    exchange,
    perturb_camera,
    perturb_light,
)
from derender.scene.ranges import SceneRanges

MANY = 20_000
QUARTER = math.radians(45)


def seeded(seed: int) -> Generator:
    return Generator().manual_seed(seed)


def uniformity(values: torch.Tensor, low: float, high: float) -> float:
    """Kolmogorov-Smirnov distance to the uniform law on [low, high], times sqrt(n); 1.95 at p = 0.001."""
    ordered = ((values.double() - low) / (high - low)).sort().values
    expected = (torch.arange(len(ordered), dtype=torch.float64) + 0.5) / len(ordered)
    return ((ordered - expected).abs().max() * math.sqrt(len(ordered))).item()


def lights(generator: Generator) -> torch.Tensor:
    light = torch.rand(MANY, 4, generator=generator)
    light[:, 2:] = (light[:, 2:] * 2 - 1) * QUARTER
    return light


def test_light_from_the_middle_is_uniform_over_the_papers_ranges(generator):
    light = torch.tensor([0.5, 0.5, 0.0, 0.0]).expand(MANY, 4)
    result = perturb_light(light, generator)
    for column, half in enumerate((0.5, 0.5, QUARTER, QUARTER)):
        centre = light[0, column].item()
        assert uniformity(result[:, column], centre - half, centre + half) < 1.95
    correlation = torch.corrcoef(result.T) - torch.eye(4)
    assert correlation.abs().max() < 4 / math.sqrt(MANY), "the four numbers must be drawn by themselves"


def test_camera_from_the_middle_is_uniform_in_pitch_and_yaw_and_untouched_elsewhere(generator):
    camera = torch.tensor([0.0, 0.0, 0.3, 0.01, -0.02, 0.0]).expand(MANY, 6)
    result = perturb_camera(camera, generator)
    assert uniformity(result[:, 0], -QUARTER / 2, QUARTER / 2) < 1.95
    assert uniformity(result[:, 1], -QUARTER, QUARTER) < 1.95
    assert torch.equal(result[:, 2:], camera[:, 2:])


def test_at_a_bound_the_change_is_uniform_over_what_is_physical(generator):
    light = torch.tensor([1.0, 0.0, QUARTER, -QUARTER]).expand(MANY, 4)
    result = perturb_light(light, generator)
    for column, (low, high) in enumerate(((0.5, 1.0), (0.0, 0.5), (0.0, QUARTER), (-QUARTER, 0.0))):
        assert uniformity(result[:, column], low, high) < 1.95
    limit = math.radians(60)
    turned = perturb_camera(torch.tensor([limit, -limit, 0, 0, 0, 0]).expand(MANY, 6), generator)
    assert uniformity(turned[:, 0], limit - QUARTER / 2, limit) < 1.95
    assert uniformity(turned[:, 1], -limit, -limit + QUARTER) < 1.95


def test_bounds_come_from_the_scene_ranges_and_sizes_from_the_settings(generator):
    cars = SceneRanges(diffuse=(0.5, 1.0), light_deg=20.0, rotation_deg=10.0)
    light = perturb_light(
        torch.tensor([0.5, 0.75, 0.0, 0.0]).expand(MANY, 4), generator, PerturbSettings(), cars
    )
    assert uniformity(light[:, 1], 0.5, 1.0) < 1.95
    assert light[:, 2:].abs().max() <= math.radians(20) + 1e-6
    camera = perturb_camera(torch.zeros(MANY, 6), generator, PerturbSettings(), cars)
    assert camera[:, 1].abs().max() <= math.radians(10) + 1e-6
    small = PerturbSettings(ambient=0.1, diffuse=0.0, light_deg=0.0, camera_pitch_deg=0.0, camera_yaw_deg=5.0)
    start = torch.tensor([0.5, 0.4, 0.1, -0.2]).expand(MANY, 4)
    result = perturb_light(start, generator, small)
    assert uniformity(result[:, 0], 0.4, 0.6) < 1.95
    torch.testing.assert_close(result[:, 1:], start[:, 1:])
    turned = perturb_camera(torch.zeros(MANY, 6), generator, small)
    assert torch.equal(turned[:, 0], torch.zeros(MANY))
    assert uniformity(turned[:, 1], -math.radians(5), math.radians(5)) < 1.95


def test_a_prediction_outside_its_bounds_is_brought_back(generator):
    result = perturb_light(torch.tensor([[1.4, -3.0, 2.0, -2.0]]).expand(100, 4), generator)
    assert ((result[:, 0] >= 0.5) & (result[:, 0] <= 1)).all() and (
        (result[:, 1] >= 0) & (result[:, 1] <= 0.5)
    ).all()
    assert (result[:, 2] >= -1e-6).all() and (result[:, 3] <= 1e-6).all()


def test_the_perturbed_value_keeps_its_gradient():
    light = torch.tensor([[0.5, 0.5, 0.0, 0.0]], requires_grad=True)
    loose = SceneRanges(light_deg=89.0)
    perturb_light(
        light, seeded(0), PerturbSettings(ambient=0.2, diffuse=0.2, light_deg=20.0), loose
    ).sum().backward()
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
    counts: dict[tuple[int, ...], int] = {}
    for _ in range(4500):
        order = tuple(derangement(4, generator).tolist())
        assert sorted(order) == [0, 1, 2, 3] and all(i != place for i, place in enumerate(order))
        counts[order] = counts.get(order, 0) + 1
    assert len(counts) == 9
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
    assert abs((chosen == 2).float().mean().item() - 0.5) < 4 * 0.5 / math.sqrt(MANY)
    follows = (chosen[1:] == chosen[:-1]).float().mean().item()
    assert abs(follows - 0.5) < 4 * 0.5 / math.sqrt(MANY)
    with pytest.raises(ValueError, match="no factor to choose"):
        choose_factors(3, (), generator)


def test_settings_are_the_papers_and_refuse_negative_sizes_and_unknown_names():
    sizes = {"ambient": 0.5, "diffuse": 0.5, "light_deg": 45, "camera_pitch_deg": 22.5, "camera_yaw_deg": 45}
    assert PerturbSettings().model_dump() == sizes
    for name in sizes:
        assert getattr(PerturbSettings(**{name: 0.0}), name) == 0
        with pytest.raises(ValueError, match=name):
            PerturbSettings(**{name: -0.1})
    with pytest.raises(ValueError, match="embient"):
        PerturbSettings.model_validate({"embient": 0.1})
