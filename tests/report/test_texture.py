"""Albedo taken back from an image: exact where it can be seen, the model's where it cannot."""

from dataclasses import replace

import pytest
import torch

from derender.render import render_scene
from derender.report.texture import picture_albedo, picture_on_grid
from derender.scene import Scene

FOV_DEG = 10.0
SIZE = 48


@pytest.fixture
def painted() -> Scene:
    """A hill with stripes, turned to a side by enough to hide the foot of its far flank."""
    axis = torch.linspace(-1, 1, SIZE)
    y, x = axis[:, None].expand(SIZE, SIZE), axis.expand(SIZE, SIZE)
    depth = 1.04 - 0.08 * torch.exp(-5 * (x**2 + y**2))
    stripes = torch.stack(
        (0.5 + 0.3 * torch.sin(9 * x), 0.5 + 0.3 * torch.cos(9 * y), torch.full_like(x, 0.4))
    )
    light, camera = torch.tensor([[0.4, 0.5, 0.1, -0.2]]), torch.tensor([[0.0, 0.6, 0.0, 0.0, 0.0, 0.0]])
    return Scene(depth[None], stripes[None], light, camera)


def grey(scene: Scene) -> Scene:
    return replace(scene, albedo=torch.full_like(scene.albedo, 0.9))


def test_albedo_comes_back_where_it_is_seen_and_stays_where_it_is_hidden(painted):
    seen = render_scene(painted, FOV_DEG)
    found = picture_albedo(seen.image, grey(painted), FOV_DEG)
    error = (found - painted.albedo).abs().mean(dim=1)[0]
    changed = (found - 0.9).abs().amax(dim=1)[0] > 1e-4
    near = error < 0.02
    assert near[16:32, 29:39].all()  # the flank that is turned to the camera
    assert changed.float().mean() > 0.3
    assert not changed[22:26, 10:19].any()  # behind the hill
    assert found.min() >= 0 and found.max() <= 1


def test_the_scene_then_gives_the_picture_back(painted):
    seen = render_scene(painted, FOV_DEG)
    found = replace(painted, albedo=picture_albedo(seen.image, grey(painted), FOV_DEG))
    again, before = render_scene(found, FOV_DEG), render_scene(grey(painted), FOV_DEG)
    middle = (0, slice(None), slice(18, 30), slice(26, 38))
    error = (again.image - seen.image)[middle].abs().mean()
    assert float(error) < 0.02 < 0.1 < float((before.image - seen.image)[middle].abs().mean())


def test_in_the_dark_the_models_albedo_stays(painted):
    dark = replace(grey(painted), light=torch.tensor([[0.05, 0.0, 0.0, 0.0]]))
    found = picture_albedo(torch.rand(1, 3, SIZE, SIZE), dark, FOV_DEG)
    torch.testing.assert_close(found, dark.albedo)


def test_a_large_picture_meets_the_enlarged_grid():
    """Value = place in the image, 0 at its left edge and 1 at its right one."""
    size, model_size = 64, 8
    across = (torch.arange(size) + 0.5) / size
    picture = across.expand(1, 3, size, size)
    moved = picture_on_grid(picture, model_size)[0, 0, 0]
    centres = torch.linspace(0.5 / model_size, 1 - 0.5 / model_size, size)
    torch.testing.assert_close(moved, centres, atol=1e-4, rtol=0)


def test_sizes_have_to_agree(painted):
    with pytest.raises(ValueError, match=r"one size.*at_size"):
        picture_albedo(torch.zeros(1, 3, 8, 8), painted, FOV_DEG)
