"""Scene: one value that carries every parameter, extras included, and refuses unknown names."""

import pytest
import torch

from derender.render import render
from derender.scene import Scene
from derender.scene.scene import seen_in_mirror


@pytest.fixture
def scene() -> Scene:
    maps = torch.ones(3, 4, 5), torch.rand(3, 3, 4, 5)
    return Scene(*maps, torch.rand(3, 4), torch.rand(3, 6), {"shine": torch.arange(3.0)})


def test_parameters_round_trip(scene):
    assert list(scene.parameters) == ["depth", "albedo", "light", "camera", "shine"]
    again = Scene.from_parameters(scene.parameters)
    assert all(torch.equal(again.parameters[name], value) for name, value in scene.parameters.items())
    assert len(scene) == 3


@pytest.mark.parametrize("rows", [[2, 0], slice(0, 2), torch.tensor([True, False, True]), 0, -1])
def test_rows_are_selected_from_every_parameter(scene, rows):
    chosen = scene[rows]
    for name, value in chosen.parameters.items():
        expected = scene.parameters[name][rows]
        assert torch.equal(value, expected[None] if isinstance(rows, int) else expected)


def test_with_parameters_changes_those_and_leaves_the_first_scene_alone(scene):
    before = scene.light.clone()
    changed = scene.with_parameters(light=torch.zeros(3, 4), shine=torch.ones(3))
    assert torch.equal(scene.light, before)
    assert torch.equal(changed.light, torch.zeros(3, 4)) and torch.equal(changed.camera, scene.camera)
    assert torch.equal(changed.extra["shine"], torch.ones(3))


def test_unknown_and_missing_parameters_are_named(scene):
    with pytest.raises(ValueError, match="unknown scene parameter 'ligth'"):
        scene.with_parameters(ligth=torch.zeros(3, 4))
    with pytest.raises(ValueError, match="missing: camera"):
        Scene.from_parameters({"depth": scene.depth, "albedo": scene.albedo, "light": scene.light})
    with pytest.raises(ValueError, match="shine is not known"):
        seen_in_mirror(scene)


def test_the_image_of_the_mirrored_scene_is_the_mirror_image():
    generator = torch.Generator().manual_seed(0)
    line = torch.linspace(-1, 1, 33)
    bump = 1 - 0.08 * torch.exp(-4 * (line[:, None].square() + (line - 0.2).square()))
    albedo = torch.rand(4, 3, 33, 33, generator=generator)
    light = torch.tensor([[0.2, 0.7, 0.3, 0.5], [0.4, 0.4, -0.2, -0.6], [0.1, 0.9, 0.6, 0.1], [0, 1, 0, 0.7]])
    camera = (torch.rand(4, 6, generator=generator) - 0.5) * torch.tensor([0.6, 0.8, 0.4, 0.05, 0.05, 0.0])
    scene = Scene(bump.expand(4, 33, 33).contiguous(), albedo, light, camera)
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
