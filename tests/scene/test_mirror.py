"""The scene of a mirror image is rendered as the mirror image of the scene."""

import pytest
import torch

from derender.render import render
from derender.scene import Scene
from derender.scene.mirror import seen_in_mirror


def test_its_picture_is_the_mirror_image():
    generator = torch.Generator().manual_seed(0)
    line = torch.linspace(-1, 1, 33)
    bump = 1 - 0.08 * torch.exp(-4 * (line[:, None].square() + (line - 0.2).square()))
    depth = bump.expand(4, 33, 33).contiguous()
    albedo = torch.rand(4, 3, 33, 33, generator=generator)
    light = torch.tensor([[0.2, 0.7, 0.3, 0.5], [0.4, 0.4, -0.2, -0.6], [0.1, 0.9, 0.6, 0.1], [0, 1, 0, 0.7]])
    camera = (torch.rand(4, 6, generator=generator) - 0.5) * torch.tensor([0.6, 0.8, 0.4, 0.05, 0.05, 0.0])
    scene = Scene(depth, albedo, light, camera)
    straight, twin = (
        render(one.depth, one.albedo, one.light, one.camera, fov_deg=10.0)
        for one in (scene, seen_in_mirror(scene))
    )
    assert (straight.image - straight.image.flip(-1)).abs().mean() > 0.1, "the scenes are not symmetric"
    both = (straight.mask.flip(-1) * twin.mask).bool()
    assert both.float().mean() > 0.5
    assert (straight.mask.flip(-1) != twin.mask).float().mean() < 0.02
    apart = (straight.image.flip(-1) - twin.image).abs().mean(dim=1)[both]
    assert apart.median() < 1e-3  # where triangles' diagonals lie the other way a little more
    assert apart.mean() < 5e-3


def test_a_mirror_of_a_mirror_shows_the_scene():
    scene = Scene(torch.rand(2, 8, 8), torch.rand(2, 3, 8, 8), torch.rand(2, 4), torch.rand(2, 6))
    twice = seen_in_mirror(seen_in_mirror(scene))
    assert all(torch.equal(value, scene.parameters[name]) for name, value in twice.parameters.items())


def test_further_factors_are_refused():
    scene = Scene(torch.rand(1, 8, 8), torch.rand(1, 3, 8, 8), torch.rand(1, 4), torch.rand(1, 6))
    with pytest.raises(ValueError, match="haze is not known"):
        seen_in_mirror(scene.with_extra(haze=torch.rand(1, 2)))
