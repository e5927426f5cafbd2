"""Enlarged scenes: B-splines against SciPy's, slopes that stay, and what must not change."""

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline

from derender.render import render_scene
from derender.scene import Scene
from derender.scene.enlarge import at_size, cubic_weights
from derender.scene.normals import normals_from_depth

FOV_DEG = 10.0


def hill(size: int) -> Scene:
    """A smooth hill, lit from the side, with colours that change slowly."""
    axis = torch.linspace(-1, 1, size)
    y, x = axis[:, None].expand(size, size), axis.expand(size, size)
    depth = 1.0 - 0.05 * torch.exp(-3 * (x**2 + y**2))
    albedo = 0.5 + 0.3 * torch.stack((x, y, x * y))
    light, camera = torch.tensor([[0.3, 0.6, 0.2, 0.4]]), torch.tensor([[0.1, 0.2, 0.0, 0.0, 0.0, 0.0]])
    return Scene(depth[None], albedo[None], light, camera)


def test_weights_are_those_of_a_cubic_b_spline():
    values = np.random.default_rng(0).normal(size=9)
    ends = 2 * values[0] - values[1], 2 * values[-1] - values[-2]
    spline = BSpline(np.arange(-3, 12) + 0.0, np.concatenate(([ends[0]], values, [ends[1]])), 3)
    places = np.linspace(0, 8, 23)
    made = cubic_weights(torch.from_numpy(places), 9, "smooth").numpy() @ values
    np.testing.assert_allclose(made, spline(places), atol=1e-12)
    assert made[0] == pytest.approx(values[0]) and made[-1] == pytest.approx(values[-1])


@pytest.mark.parametrize("kind", ["smooth", "sharp"])
def test_weights_keep_straight_lines(kind):
    places = torch.linspace(0, 6, 31, dtype=torch.float64)
    weights = cubic_weights(places, 7, kind)
    torch.testing.assert_close(weights.sum(dim=1), torch.ones(31, dtype=torch.float64))
    torch.testing.assert_close(weights @ torch.arange(7, dtype=torch.float64), places)


def test_normals_stay_at_the_old_pixels():
    scene = hill(24)
    fine = at_size(scene, 23 * 8 + 1)
    old = normals_from_depth(scene.depth, FOV_DEG)
    new = normals_from_depth(fine.depth, FOV_DEG)[:, ::8, ::8]
    assert float((old * new).sum(dim=-1)[:, 1:-1, 1:-1].min()) > 0.9995


def test_an_enlarged_scene_looks_the_same():
    coarse, fine = hill(32), hill(32 * 4 - 3)
    made = render_scene(at_size(coarse, 32 * 4 - 3), FOV_DEG)
    exact = render_scene(fine, FOV_DEG)
    both = (made.mask * exact.mask) > 0
    assert both.float().mean() > 0.8
    assert float(((made.image - exact.image).abs().mean(dim=1) * both).max()) < 0.02


def test_light_camera_and_size_are_kept():
    scene = hill(16)
    assert at_size(scene, 16) is scene
    fine = at_size(scene, 40)
    assert fine.depth.shape == (1, 40, 40) and fine.albedo.shape == (1, 3, 40, 40)
    assert fine.light is scene.light and fine.camera is scene.camera
    assert scene.depth.min() <= fine.depth.min() and fine.depth.max() <= scene.depth.max()
    assert float(fine.albedo.min()) >= 0 and float(fine.albedo.max()) <= 1


def test_what_cannot_be_enlarged():
    with pytest.raises(ValueError, match="16x16 cannot be shown at 8x8: give 16 or more"):
        at_size(hill(16), 8)
    assert at_size(hill(4), 8).depth.shape == (1, 8, 8)
    with pytest.raises(ValueError, match="3x3 cannot be shown at 8x8: give 4 or more"):
        at_size(hill(3), 8)
    flat = hill(16)
    narrow = Scene(flat.depth[:, :, :8], flat.albedo[..., :8], flat.light, flat.camera)
    with pytest.raises(ValueError, match="only square scenes can be enlarged, got 16x8"):
        at_size(narrow, 32)
