"""Scene: one value that carries every parameter, extras included, and refuses unknown names."""

import pytest
import torch

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
    assert torch.equal(seen_in_mirror(scene, ["shine"]).extra["shine"], scene.extra["shine"])
