"""Camera: the matrices and signs of the conventions, inverses, projection."""

import math

import pytest
import torch
from tests.render.scenes import camera
from tests.tolerances import assert_agrees

from derender.scene import camera as pinhole


def random_cameras(count: int, generator: torch.Generator) -> torch.Tensor:
    return torch.randn(count, 6, generator=generator, dtype=torch.float64)


def test_rotation_is_rz_ry_rx():
    a, b, c = 0.3, -0.7, 1.1
    rx = torch.tensor([[1, 0, 0], [0, math.cos(a), -math.sin(a)], [0, math.sin(a), math.cos(a)]])
    ry = torch.tensor([[math.cos(b), 0, math.sin(b)], [0, 1, 0], [-math.sin(b), 0, math.cos(b)]])
    rz = torch.tensor([[math.cos(c), -math.sin(c), 0], [math.sin(c), math.cos(c), 0], [0, 0, 1]])
    assert_agrees(pinhole.rotation_matrix(torch.tensor([a, b, c])), rz @ ry @ rx)


def test_to_canonical_undoes_to_camera(generator):
    points = torch.randn(4, 5, 3, 3, generator=generator, dtype=torch.float64)
    cameras = random_cameras(4, generator)
    assert_agrees(pinhole.to_canonical(pinhole.to_camera(points, cameras), cameras), points)
    assert_agrees(pinhole.to_camera(pinhole.to_canonical(points, cameras), cameras), points)


def test_to_camera_turns_about_the_object_centre_then_shifts(generator):
    cameras = random_cameras(6, generator)
    centre = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    assert_agrees(pinhole.to_camera(centre.expand(6, 1, 3), cameras)[:, 0], centre + cameras[:, 3:])


@pytest.mark.parametrize(
    ("turn", "point", "axis", "sign"),
    [
        ("rx", (0.0, -0.1, 1.0), 2, -1),  # the top comes towards the camera
        ("ry", (0.0, 0.0, 0.9), 0, -1),  # the near side moves to the left
        ("rz", (0.0, -0.1, 1.0), 0, 1),  # clockwise: the top moves to the right
    ],
)
def test_signs_of_the_angles(turn, point, axis, sign):
    before = torch.tensor([[point]], dtype=torch.float64)
    change = pinhole.to_camera(before, camera(**{turn: 0.2})) - before
    assert change[0, 0, axis] * sign > 0.01


@pytest.mark.parametrize(("height", "width"), [(64, 64), (5, 8), (9, 4)])
def test_outermost_pixel_centres_span_the_field_of_view(height, width):
    rays = pinhole.pixel_rays(height, width, 10.0, dtype=torch.float64)
    assert math.degrees(2 * math.atan(float(rays[0, -1, 0]))) == pytest.approx(10.0)
    assert_agrees(rays[:, 0, 0], -rays[:, -1, 0])
    assert_agrees(rays[0, :, 1], -rays[-1, :, 1])
    # square pixels: a step down is as long as a step to the right
    assert_agrees(rays[1, 0, 1] - rays[0, 0, 1], rays[0, 1, 0] - rays[0, 0, 0])
    assert (rays[..., 2] == 1).all()


def test_focal_length_of_synface64():
    assert pinhole.focal_px(64, 10.0) == pytest.approx(360.05, abs=0.005)


@pytest.mark.parametrize(("height", "width"), [(6, 6), (5, 8), (9, 4)])
def test_project_undoes_unproject(height, width, generator):
    depth = 0.5 + torch.rand(2, height, width, generator=generator, dtype=torch.float64)
    uv = pinhole.project(pinhole.unproject(depth, 30.0), height, width, 30.0)
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    assert_agrees(uv, torch.stack((u, v), -1).double().expand(2, -1, -1, -1))
    assert_agrees(pinhole.unproject(depth, 30.0)[..., 2], depth)


@pytest.mark.parametrize("fov_deg", [0.0, -10.0, 180.0, float("nan")])
def test_impossible_field_of_view_is_an_error(fov_deg):
    with pytest.raises(ValueError, match="fov_deg must lie between 0 and 180"):
        pinhole.focal_px(64, fov_deg)


def test_a_constant_is_made_once_for_each_kind_and_serves_gradients():
    like = torch.zeros(2, dtype=torch.float64)
    with torch.inference_mode():
        first = pinhole.constant(((0.0, 1.0), (2.0, 3.5)), like)
    assert first.tolist() == [[0, 1], [2, 3.5]] and first.dtype == torch.float64
    assert pinhole.constant(((0.0, 1.0), (2.0, 3.5)), like) is first
    assert pinhole.constant(((0.0, 1.0), (2.0, 3.5)), like.float()) is not first
    assert pinhole.shared_tensor((1, 3), like.device, torch.int64).tolist() == [1, 3]
    factor = torch.ones(2, 2, dtype=torch.float64, requires_grad=True)
    (factor * first).sum().backward()
    assert factor.grad is not None and torch.equal(factor.grad, first)


def test_translation_moves_right_down_and_away():
    before = torch.tensor([[[0.02, 0.03, 1.05]]], dtype=torch.float64)
    moved = pinhole.to_camera(before, camera(tx=0.1, ty=0.2, tz=0.3))
    assert_agrees(moved - before, torch.tensor([[[0.1, 0.2, 0.3]]], dtype=torch.float64))
