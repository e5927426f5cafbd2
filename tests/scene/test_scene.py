"""Scene: one value that carries every parameter, extras included, and refuses unknown names."""

from dataclasses import FrozenInstanceError

import pytest
import torch

from derender.scene import Scene


@pytest.fixture
def scene() -> Scene:
    return Scene(
        depth=torch.ones(3, 4, 5),
        albedo=torch.rand(3, 3, 4, 5),
        light=torch.rand(3, 4),
        camera=torch.rand(3, 6),
        extra={"shine": torch.arange(3.0)},
    )


def test_parameters_round_trip(scene):
    assert list(scene.parameters) == ["depth", "albedo", "light", "camera", "shine"]
    again = Scene.from_parameters(scene.parameters)
    assert all(torch.equal(again.parameters[name], value) for name, value in scene.parameters.items())
    assert len(scene) == 3


@pytest.mark.parametrize("rows", [[2, 0], slice(0, 2), torch.tensor([True, False, True])])
def test_rows_are_selected_from_every_parameter(scene, rows):
    chosen = scene[rows]
    for name, value in chosen.parameters.items():
        assert torch.equal(value, scene.parameters[name][rows])


@pytest.mark.parametrize("row", [0, 2, -1])
def test_an_integer_keeps_the_batch_axis(scene, row):
    chosen = scene[row]
    assert len(chosen) == 1
    assert torch.equal(chosen.light[0], scene.light[row])


def test_with_parameters_changes_those_and_leaves_the_first_scene_alone(scene):
    before = scene.light.clone()
    changed = scene.with_parameters(light=torch.zeros(3, 4), shine=torch.ones(3))
    assert torch.equal(scene.light, before)
    assert torch.equal(changed.light, torch.zeros(3, 4))
    assert torch.equal(changed.extra["shine"], torch.ones(3))
    assert torch.equal(changed.camera, scene.camera)


def test_unknown_and_missing_parameters_are_named(scene):
    with pytest.raises(ValueError, match="unknown scene parameter 'ligth'"):
        scene.with_parameters(ligth=torch.zeros(3, 4))
    with pytest.raises(ValueError, match="missing: camera"):
        Scene.from_parameters({"depth": scene.depth, "albedo": scene.albedo, "light": scene.light})


def test_a_scene_is_a_value(scene):
    with pytest.raises(FrozenInstanceError):
        scene.depth = torch.zeros(3, 4, 5)


def test_extras_are_added_and_detach_reaches_them(scene):
    grown = scene.with_extra(haze=torch.ones(3, requires_grad=True))
    assert list(grown.extra) == ["shine", "haze"]
    assert not grown.detach().extra["haze"].requires_grad
