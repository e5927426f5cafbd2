"""Light: direction, signs of the angles, Lambertian shading with known answers."""

import math

import pytest
import torch
from tests.tolerances import assert_agrees

from derender.scene.camera import pixel_rays
from derender.scene.light import lambert_shading, light_direction
from derender.scene.normals import normals_from_depth


def light(ambient: float = 0.0, diffuse: float = 1.0, pitch: float = 0.0, yaw: float = 0.0) -> torch.Tensor:
    return torch.tensor([[ambient, diffuse, pitch, yaw]], dtype=torch.float64)


def bump(size: int = 21) -> torch.Tensor:
    """Depth of a ball in front of the camera: nearest in the middle."""
    rays = pixel_rays(size, size, 10.0, dtype=torch.float64)
    b = rays[..., 2] * 1.1
    length2 = rays.square().sum(-1)
    return ((b - (b.square() - length2 * (1.1**2 - 0.15**2)).sqrt()) / length2)[None]


def test_direction_is_tan_yaw_tan_pitch_one_normalised(generator):
    angles = (torch.rand(50, 2, generator=generator, dtype=torch.float64) - 0.5) * 3.0
    expected = torch.stack((angles[:, 1].tan(), angles[:, 0].tan(), torch.ones(50, dtype=torch.float64)), -1)
    expected = expected / expected.norm(dim=-1, keepdim=True)
    assert_agrees(light_direction(torch.cat((torch.zeros_like(angles), angles), -1)), expected)


@pytest.mark.parametrize(
    ("normal", "light", "expected"),
    [
        ((0.0, math.sin(0.5), math.cos(0.5)), light(0.1, 0.6, pitch=-0.3), 0.1 + 0.6 * math.cos(0.8)),
        ((0.0, 0.0, 1.0), light(0.3, 0.9), 1.2),
        ((1.0, 0.0, 0.0), light(0.25, 0.7, yaw=-0.4), 0.25),
    ],
    ids=["the cosine between normal and light", "not clipped at 1", "turned away: ambient only"],
)
def test_shading_is_the_cosine_between_normal_and_light(normal, light, expected):
    shading = lambert_shading(torch.tensor(normal, dtype=torch.float64).expand(1, 2, 3, 3), light)
    assert_agrees(shading, torch.full((1, 1, 2, 3), expected, dtype=torch.float64))


def test_yaw_lights_the_left_and_pitch_the_top():
    normal = normals_from_depth(bump(), 10.0)
    from_left = lambert_shading(normal, light(yaw=0.5))[0, 0]
    assert (from_left[:, :10] > from_left[:, 11:].flip(1)).all()
    from_above = lambert_shading(normal, light(pitch=0.5))[0, 0]
    assert (from_above[:10] > from_above[11:].flip(0)).all()


@pytest.mark.parametrize("angle", ["pitch", "yaw"])
def test_direction_is_continuous_at_ninety_degrees(angle):
    before, after = (light_direction(light(**{angle: math.pi / 2 + step})) for step in (-1e-6, 1e-6))
    assert (before - after).abs().max() < 1e-5


def test_a_light_from_nowhere_has_finite_gradients():
    undefined = light(pitch=math.pi / 2, yaw=math.pi / 2).requires_grad_()
    light_direction(undefined).sum().backward()
    assert light_direction(undefined).isfinite().all() and undefined.grad.isfinite().all()
