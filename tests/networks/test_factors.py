"""Factor rows: raw network outputs become physical parameters with the stated ranges."""

import math

import torch

from derender.networks.factors import albedo_from_raw, camera_from_raw, depth_from_raw, light_from_raw
from derender.scene.ranges import SceneRanges

RANGES = SceneRanges()


def test_depth_is_centred_squashed_and_clamped_at_both_sides(generator):
    raw = 3 * torch.randn(2, 1, 64, 64, generator=generator) + 40
    depth = depth_from_raw(raw, RANGES)
    torch.testing.assert_close(depth[:, :, :2], torch.full((2, 64, 2), 1.04))
    torch.testing.assert_close(depth[:, :, -2:], torch.full((2, 64, 2), 1.04))
    expected = 1 + 0.1 * (raw - raw.mean(dim=(2, 3), keepdim=True)).tanh().squeeze(1)
    torch.testing.assert_close(depth[:, :, 2:-2], expected[:, :, 2:-2])
    assert depth.min() >= 0.9
    assert depth.max() <= 1.1


def test_level_depth_loses_its_slope_from_top_to_bottom_and_nothing_else(generator):
    level = SceneRanges(level_depth=True, border_share=0)
    raw = 0.01 * torch.randn(2, 1, 48, 64, generator=generator)
    down = torch.linspace(-1, 1, 48)[:, None].expand(48, 64)
    torch.testing.assert_close(depth_from_raw(raw + 0.3 * down, level), depth_from_raw(raw, level))
    across = raw + 0.3 * torch.linspace(-1, 1, 64)
    assert (depth_from_raw(across, level) - depth_from_raw(raw, level)).abs().max() > 0.02
    ridge = (raw * 0 + torch.exp(-((down * 3) ** 2))).contiguous()  # the same above and below: no slope
    plain = SceneRanges(border_share=0)
    torch.testing.assert_close(depth_from_raw(ridge, level), depth_from_raw(ridge, plain))


def test_a_flat_map_leans_back_by_the_angle_asked_for():
    leaning = SceneRanges(lean_deg=30.0, border_share=0, level_depth=True)
    depth = depth_from_raw(torch.zeros(1, 1, 64, 64), leaning)[0]
    height = depth[31:33] * torch.tensor([[0.5], [-0.5]]) / (63 / 2 / math.tan(math.radians(5)))
    lean = (depth[31] - depth[32]) / (height[0] - height[1])  # away for every unit up, in the middle
    expected = torch.full((64,), math.tan(math.radians(30)))
    torch.testing.assert_close(lean, expected, rtol=2e-3, atol=0, check_dtype=False)
    assert (depth[:-1] > depth[1:]).all()
    upright = depth_from_raw(torch.zeros(1, 1, 64, 64), SceneRanges(border_share=0, level_depth=True))
    torch.testing.assert_close(depth + depth.flip(0), 2 * upright[0])


def test_albedo_spans_0_to_1():
    raw = torch.tensor([-100.0, 0.0, 100.0]).view(1, 3, 1, 1)
    torch.testing.assert_close(albedo_from_raw(raw, RANGES).flatten(), torch.tensor([0.0, 0.5, 1.0]))


def test_light_ends_are_the_ranges_ends_and_angles_are_arctangents():
    raw = torch.tensor([[-1.0, 1.0, 1.0, -1.0], [1.0, -1.0, 0.5, 0.0]])
    light = light_from_raw(raw, RANGES)
    quarter = math.pi / 4
    torch.testing.assert_close(light[0], torch.tensor([0.0, 1.0, quarter, -quarter]))
    torch.testing.assert_close(light[1], torch.tensor([1.0, 0.0, math.atan(0.5), 0.0]))


def test_camera_ends_are_60_degrees_and_a_tenth():
    ranges = SceneRanges(translation_z=0.1)
    camera = camera_from_raw(torch.ones(1, 6), ranges)
    torch.testing.assert_close(camera[0], torch.tensor([math.pi / 3] * 3 + [0.1] * 3))
    assert camera_from_raw(torch.ones(1, 6), RANGES)[0, 5] == 0
