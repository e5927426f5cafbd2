"""Normals of depth maps: exact on planes, close on a ball, equal to the differences they stand for."""

import math

import pytest
import torch
from tests.tolerances import assert_agrees
from torch import Tensor
from torch.nn.functional import normalize

from derender.scene.camera import pixel_rays, unproject
from derender.scene.normals import normals_from_depth

FOV_DEG = 10.0


def plane(normal: Tensor, height: int, width: int) -> Tensor:
    """Depth (1, H, W) of the plane through (0, 0, 1) with this normal."""
    rays = pixel_rays(height, width, FOV_DEG, dtype=torch.float64)
    return (normal[2] / (rays @ normal))[None]


@pytest.mark.parametrize(("height", "width"), [(2, 2), (3, 8), (9, 4)])
@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.5, 0.0), (0.0, -1.0), (1.3, 0.4)])
def test_exact_on_planes_up_to_the_border(height, width, tilt):
    expected = normalize(torch.tensor([math.tan(tilt[0]), math.tan(tilt[1]), 1.0]).double(), dim=0)
    normal = normals_from_depth(plane(expected, height, width), FOV_DEG)
    assert_agrees(normal, expected.expand(1, height, width, 3))


def test_equals_the_cross_product_of_differences(generator):
    depth = 0.9 + 0.2 * torch.rand(3, 6, 9, generator=generator, dtype=torch.float64)
    points = unproject(depth, FOV_DEG)
    along_u = points[:, 1:-1, 2:] - points[:, 1:-1, :-2]
    along_v = points[:, 2:, 1:-1] - points[:, :-2, 1:-1]
    expected = normalize(torch.linalg.cross(along_u, along_v), dim=-1)
    assert_agrees(normals_from_depth(depth, FOV_DEG)[:, 1:-1, 1:-1], expected)
    corner = torch.linalg.cross(points[:, 0, 1] - points[:, 0, 0], points[:, 1, 0] - points[:, 0, 0])
    assert_agrees(normals_from_depth(depth, FOV_DEG)[:, 0, 0], normalize(corner, dim=-1))
    corner = torch.linalg.cross(points[:, -1, -1] - points[:, -1, -2], points[:, -1, -1] - points[:, -2, -1])
    assert_agrees(normals_from_depth(depth, FOV_DEG)[:, -1, -1], normalize(corner, dim=-1))


def test_a_single_row_is_an_error():
    with pytest.raises(ValueError, match="at least 2x2 pixels, got 1x5"):
        normals_from_depth(torch.ones(1, 1, 5), FOV_DEG)
