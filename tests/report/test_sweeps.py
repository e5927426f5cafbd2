"""Sweeps of light and view: ends, signs, what stays; swaps."""

from functools import partial
from math import radians

import numpy as np
import pytest
import torch

from derender.render import render_scene
from derender.report import sweeps
from derender.report.colours import on_background
from derender.scene import Scene

FOV_DEG = 10.0
render = partial(render_scene, fov_deg=FOV_DEG)


def ball(size: int = 24) -> Scene:
    axis = torch.linspace(-1, 1, size)
    depth = 1.04 - 0.06 * torch.exp(-4 * (axis[:, None] ** 2 + axis[None] ** 2))
    light = torch.tensor([[0.2, 0.7, 0.1, 0.3]])
    return Scene(depth[None], torch.full((1, 3, size, size), 0.6), light, torch.zeros(1, 6))


def test_places():
    assert sweeps.stills(3).tolist() == [0, 0.5, 1]
    film = sweeps.there_and_back(8)
    torch.testing.assert_close(film[[0, 2, 4, 6]], torch.tensor([0.0, 0.5, 1.0, 0.5]))
    assert float(film[0] - film[-1]) == pytest.approx(float(film[0] - film[1]))  # the loop closes


def test_light_goes_from_the_right_of_the_picture_to_its_left():
    lights = sweeps.lights_around(sweeps.stills(3), 50, 10)
    torch.testing.assert_close(lights[:, 3], torch.tensor([radians(-50), 0, radians(50)]))
    torch.testing.assert_close(lights[:, 2], torch.full((3,), radians(10)))
    images = render(sweeps.varied(ball(), light=lights)).image
    left, right = images[..., :11].mean(dim=(1, 2, 3)), images[..., -11:].mean(dim=(1, 2, 3))
    assert left[0] < right[0] and left[2] > right[2]
    assert float(left[1]) == pytest.approx(float(right[1]), abs=1e-3)


def test_turning_looks_right_first_then_left():
    cameras = sweeps.cameras_around(sweeps.stills(3), 30)
    torch.testing.assert_close(cameras[1], torch.zeros(6))
    spotted = ball()
    spotted = spotted.with_parameters(albedo=torch.zeros_like(spotted.albedo))
    spotted.albedo[:, 0, 10:14, 10:14] = 1  # on the tip of the nose
    images = render(sweeps.varied(spotted, camera=cameras)).image
    red = images[:, 0].sum(dim=1)
    first, middle, last = ((red * torch.arange(24.0)).sum(dim=1) / red.sum(dim=1)).tolist()
    assert first > middle + 0.5 and middle - 0.5 > last
    torch.testing.assert_close(images[1:2], render(spotted).image)


def test_only_the_swept_parameter_changes():
    scene = ball()
    changed = sweeps.varied(scene, camera=sweeps.cameras_around(sweeps.stills(4), 20, 5))
    assert len(changed) == 4
    for name in ("depth", "albedo", "light"):
        values = changed.parameters[name]
        torch.testing.assert_close(values, scene.parameters[name].expand_as(values))


def test_swapping_takes_one_parameter():
    scene, donor = ball(), ball()
    donor = donor.with_parameters(light=donor.light + 0.1, albedo=donor.albedo * 0.5)
    mixed = sweeps.swapped(scene, donor, "light")
    torch.testing.assert_close(mixed.light, donor.light)
    torch.testing.assert_close(mixed.albedo, scene.albedo)
    with pytest.raises(ValueError, match="unknown parameter 'geometry'; there is depth, albedo"):
        sweeps.swapped(scene, donor, "geometry")


def test_loops_move_and_close():
    for loop in (sweeps.circling_light, sweeps.nodding_view):
        scene = loop(ball(), 8)
        frames = sweeps.drawn(scene, render)
        assert len(frames) == 8 and len({frame.tobytes() for frame in frames}) > 4
        first, last = (np.asarray(on_background(frame)).astype(int) for frame in (frames[0], frames[-1]))
        assert np.abs(first - last).mean() < 40
    assert [frame.size for frame in sweeps.relit_and_rotated(ball(), render, 2)] == [(48, 24)] * 2


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: sweeps.lights_around(sweeps.stills(2), 90), "reach must lie between -90 and 90"),
        (lambda: sweeps.lights_around(sweeps.stills(2), 9, strength=-1), "strength of a light must be 0"),
        (lambda: sweeps.cameras_around(sweeps.stills(2), 10, 95), "pitch must lie between"),
    ],
)
def test_bad_sweeps(call, message):
    with pytest.raises(ValueError, match=message):
        call()
