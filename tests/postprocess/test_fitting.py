"""Fitting by rendering: known scenes are found again, each image by itself; damaged files are refused."""

import math
import sys

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

import derender
from derender.data.synthetic import faces
from derender.postprocess.fitting import Fitting, FittingSettings, MorphableMaps
from derender.render import render_scene
from derender.scene import Scene

SIZE, COUNT = 24, 5


def bumps(draw: torch.Generator, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Depths and albedos of a family: a hill of some height and width, and two colours side by side."""
    y, x = torch.meshgrid(*[torch.linspace(-1, 1, SIZE)] * 2, indexing="ij")
    height = 0.03 + 0.02 * torch.randn(count, 1, 1, generator=draw)
    narrow = torch.randn(count, 1, 1, generator=draw) * 0.01
    hill = torch.exp(-3 * (x**2 + y**2))
    depth = 1.05 - height * hill - narrow * torch.exp(-12 * (x**2 + y**2))
    colour = 0.5 + 0.12 * torch.randn(count, 3, 1, 1, generator=draw)
    lip = 0.1 * torch.randn(count, 1, 1, 1, generator=draw) * torch.exp(-30 * (y - 0.4) ** 2)
    return depth, (colour + lip).expand(-1, 3, SIZE, SIZE).clamp(0.05, 0.95)


@pytest.fixture(scope="module")
def maps() -> MorphableMaps:
    depth, albedo = bumps(torch.Generator().manual_seed(0), 200)
    return MorphableMaps.of({"depth": depth, "albedo": albedo}, 6)


@pytest.fixture(scope="module")
def truth() -> Scene:
    depth, albedo = bumps(torch.Generator().manual_seed(1), COUNT)
    light = torch.tensor([[0.3, 0.6, 0.2, -0.6]]).repeat(COUNT, 1)
    camera = torch.tensor([[0.1, -0.3, 0.05, 0.01, 0.0, 0.0]]).repeat(COUNT, 1)
    return Scene(depth, albedo, light, camera)


@pytest.fixture(scope="module")
def wrong(truth, maps) -> Scene:
    """Where encoders that know no such light would begin: the usual thing, seen from nearly there."""
    depth, albedo = (maps.maps(name, torch.zeros(COUNT, maps.size(name))) for name in ("depth", "albedo"))
    light = torch.tensor([[0.5, 0.4, 0.0, 0.0]]).repeat(COUNT, 1)
    return Scene(depth, albedo, light, truth.camera * 0.6)


def relief(depth: torch.Tensor) -> torch.Tensor:
    """A surface but for its distance and height, which light and tilt can stand for (bas-relief)."""
    centred = depth - depth.mean(dim=(1, 2), keepdim=True)
    return centred / centred.flatten(1).norm(dim=1)[:, None, None]


def test_a_scene_is_found_from_its_picture(maps, truth, wrong):
    pictures = render_scene(truth).image
    fitting = Fitting(maps, FittingSettings(prior=0.05))
    result = fitting.fit(pictures, wrong, render_scene, 200)
    assert (result.after < 0.25 * result.before).all()

    def apart(scene: Scene) -> dict[str, float]:
        result = {"relief": relief(scene.depth) - relief(truth.depth), "albedo": scene.albedo - truth.albedo}
        result["light"] = (scene.light[:, 2:] - truth.light[:, 2:]).norm(dim=1)
        result["yaw"] = scene.camera[:, 1] - truth.camera[:, 1]
        return {name: float(value.abs().mean()) for name, value in result.items()}

    before, after = apart(wrong), apart(result.scene)
    assert after["relief"] < 0.2 * before["relief"]
    assert all(after[name] < 0.6 * before[name] for name in before), (before, after)
    assert set(result.coordinates) == {"geometry", "albedo"}
    for factor, parameter in (("geometry", "depth"), ("albedo", "albedo")):
        made = maps.maps(parameter, result.coordinates[factor]).clamp(0, 1 if factor == "albedo" else 2)
        torch.testing.assert_close(made, result.scene.parameters[parameter])


def test_each_picture_is_fitted_by_itself(maps, truth, wrong):
    pictures = render_scene(truth).image
    fitting = Fitting(maps, FittingSettings(steps=8))
    together = fitting.fit(pictures, wrong, render_scene).coordinates
    alone = fitting.fit(pictures[2:3], wrong[2], render_scene).coordinates
    for name in ("geometry", "albedo"):
        torch.testing.assert_close(together[name][2:3], alone[name], rtol=1e-3, atol=1e-4)


def test_features_do_not_depend_on_neighbours_or_threads():
    """Encoders differ by rounding; 20 steps downhill would magnify it to a tenth if batches met there."""
    images = torch.from_numpy(np.ascontiguousarray(faces.generate(6, 64, seed=3).images)).float() / 255
    model = derender.load("rendered-faces-64")
    model = model.with_features(model.features.with_steps(20))
    threads, encoded = torch.get_num_threads(), {"geometry": 192, "albedo": 192}
    with torch.inference_mode():
        together, alone = model.embed(images), [model.embed(one[None]) for one in images[:2]]
        try:
            torch.set_num_threads(3 - min(threads, 2))
            otherwise = model.embed(images)
        finally:
            torch.set_num_threads(threads)
    for name, one in together.items():
        for other in (torch.cat([each[name] for each in alone]), otherwise[name]):
            apart = (one[: len(other)] - other).abs().amax(dim=0) / one.abs().max()
            by_encoder, by_fit = apart[: encoded.get(name)], apart[encoded.get(name, len(apart)) :]
            largest = float(by_encoder.max()), max(by_fit.tolist(), default=0.0)
            sys.stdout.write(f"{name}: {largest[0]:.1e} of encoders, {largest[1]:.1e} of fitted scenes\n")
            assert largest[0] <= 1e-5 and largest[1] <= 1e-3
    assert threads == torch.get_num_threads()


def test_what_was_given_stays_and_no_gradient_is_left(maps, truth, wrong):
    pictures = render_scene(truth).image
    kept = [value.clone() for value in (pictures, *wrong.parameters.values())]
    with torch.inference_mode():
        result = Fitting(maps, FittingSettings(steps=3)).fit(pictures, wrong, render_scene)
    assert all(torch.equal(a, b) for a, b in zip(kept, (pictures, *wrong.parameters.values()), strict=True))
    assert not any(value.requires_grad for value in result.scene.parameters.values())
    assert not any(value.requires_grad for value in result.coordinates.values())


def test_light_and_view_stay_where_a_renderer_holds(maps, truth, wrong):
    noise = torch.rand(COUNT, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(3))
    result = Fitting(maps, FittingSettings(steps=80, prior=0)).fit(noise, wrong, render_scene)
    assert all(bool(value.isfinite().all()) for value in result.scene.parameters.values())
    assert bool((result.scene.light[:, 2:].abs() <= math.radians(80) + 1e-6).all())
    assert bool((result.scene.light[:, :2] > 0).all())
    assert bool((result.scene.camera[:, :3].abs() <= math.radians(75) + 1e-6).all())


def test_a_scene_that_is_seen_nowhere_gives_numbers(maps, truth, wrong):
    away = wrong.with_parameters(camera=torch.tensor([[0, 0, 0, 5.0, 0, 0]]).repeat(COUNT, 1))
    result = Fitting(maps, FittingSettings(steps=2)).fit(truth.albedo, away, render_scene)
    assert bool(result.after.isfinite().all()) and bool(result.scene.depth.isfinite().all())


def test_no_steps_and_steps_without_examples_are_refused(maps, truth, wrong):
    with pytest.raises(ValueError, match="1 step or more, got 0"):
        Fitting(maps, FittingSettings()).fit(truth.albedo, wrong, render_scene)
    with pytest.raises(ValueError, match="2 examples or more, got 0"):
        FittingSettings(steps=10, examples=0)


def test_saved_and_loaded(maps, truth, wrong, tmp_path):
    fitting = Fitting(maps, FittingSettings(steps=4, prior=0.2), length=1.5)
    fitting.save(tmp_path / "fitting.safetensors")
    again = Fitting.load(tmp_path / "fitting.safetensors")
    assert again.settings == fitting.settings
    one, two = (f.fit(truth.albedo, wrong, render_scene).coordinates for f in (fitting, again))
    assert all(torch.equal(one[name], two[name]) for name in one)
    assert torch.equal(fitting.features(torch.ones(1, 1)), again.features(torch.ones(1, 1)))
    assert fitting.state_dict() == {}  # a model's weights are the same with it and without


@pytest.mark.parametrize(
    ("tensors", "told"),
    [
        ({}, {}),
        ({}, {"settings": "{"}),
        ({}, {"settings": '{"steps": -1}'}),
        ({"maps.depth_mean": torch.zeros(4, 4)}, {"settings": "{}"}),
    ],
)
def test_a_file_of_something_else_is_refused(tmp_path, tensors, told):
    file = tmp_path / "fitting.safetensors"
    save_file({"length": torch.ones(()), **tensors}, file, metadata=told)
    with pytest.raises(ValueError, match="holds no fitting"):
        Fitting.load(file)


def test_measured_directions_lead_further_than_the_coordinates_themselves(monkeypatch):
    images = torch.from_numpy(np.ascontiguousarray(faces.generate(4, 64, seed=5).images)).float() / 255
    along = derender.load("rendered-faces-64").fit_scenes(images, 12)
    method = "_measured_directions"
    monkeypatch.setattr(Fitting, method, lambda self, render, rates, sizes: torch.eye(len(rates)))
    monkeypatch.setattr("derender.postprocess.fitting._STEP", 1.0)
    plain = derender.load("rendered-faces-64").fit_scenes(images, 12)
    assert torch.equal(along.before, plain.before)
    assert (along.before - along.after).mean() > 1.15 * (plain.before - plain.after).mean()
