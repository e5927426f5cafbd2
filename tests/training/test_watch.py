"""The watcher: each sign on a scene made to show it, and a real collapse caught while its loss falls."""

import json
import math
from dataclasses import replace

import pytest
import torch

import derender
from derender.data import ImageSet
from derender.data.synthetic import faces
from derender.model import Derenderer
from derender.scene import Scene
from derender.scene.ranges import SceneRanges
from derender.training import loop, resolve, train
from derender.training import watch as watching
from derender.training.run_folder import read_metrics
from derender.training.watch import SIGNS, Finding, Watcher

RANGES = SceneRanges()
STEP = 500
BATCH = 16


def healthy_scene(count: int = 4, size: int = 64) -> Scene:
    """Round heads of different depth, turned and lit differently."""
    axis = torch.linspace(-1, 1, size)
    radius = (axis[:, None].square() + axis[None].square()).sqrt().clamp(max=1)
    height = torch.linspace(0.05, 0.09, count)
    depth = 1.04 - height[:, None, None] * (1 - radius.square())
    light = torch.tensor([0.4, 0.5, 0.1, 0.0]).repeat(count, 1)
    light[:, 3] = torch.linspace(-0.5, 0.5, count)
    camera = torch.zeros(count, 6)
    camera[:, 1] = torch.linspace(-0.4, 0.4, count)
    return Scene(depth, torch.full((count, 3, size, size), 0.6), light, camera)


def with_depth(change) -> Scene:
    scene = healthy_scene()
    return scene.with_parameters(depth=change(scene.depth))


def with_column(parameter: str, column: int, value: float) -> Scene:
    scene = healthy_scene()
    changed = scene.parameters[parameter].clone()
    changed[:, column] = value
    return scene.with_parameters(**{parameter: changed})


STRIPES = torch.where(torch.arange(64) % 2 == 0, 1.0, -1.0)
FAILED_SCENES = {
    "saturated depth": with_depth(lambda depth: torch.where(depth > 1.0, 1.1, 0.9)),
    "torn depth": with_depth(lambda depth: depth + 0.03 * STRIPES[None, None]),
    "flat depth": with_depth(lambda depth: 1.0 + 0.01 * (depth - 1)),
    "hollow depth": with_depth(lambda depth: 2.0 - depth),
    "view at its bound": with_column("camera", 1, math.radians(59.5)),
    "light at its bound": with_column("light", 3, math.radians(-44.5)),
    "albedo copies the image": with_column("light", 1, 0.0),
}


def measured(scene: Scene) -> dict[str, float]:
    return {name: float(value) for name, value in watching.measure(scene, RANGES).items()}


def watch(scene: Scene, images: int, watcher: Watcher | None = None, start: int = 0) -> dict[str, Finding]:
    """The findings, by sign, after so many images of one scene."""
    watcher, findings = watcher or Watcher(RANGES, BATCH), ()
    for seen in range(start + STEP, images + 1, STEP):
        findings = watcher.judge(seen, 0.1, measured(scene))
    return {finding.sign: finding for finding in findings}


def test_a_healthy_scene_raises_nothing_and_every_sign_has_a_failed_one():
    assert watch(healthy_scene(), 40_000) == {}
    assert set(FAILED_SCENES) == {sign.name for sign in SIGNS}


@pytest.mark.parametrize("sign", FAILED_SCENES)
def test_each_failure_is_found_within_20000_images_but_not_at_once_and_explained(sign):
    assert watch(FAILED_SCENES[sign], 6_000) == {}
    result = watch(FAILED_SCENES[sign], 20_000)[sign]
    assert "{" not in result.text and any(character.isdigit() for character in result.text)
    assert len(result.advice) > 20


def test_hollow_surfaces_are_inverted_once_and_then_a_failure():
    hollow, watcher = FAILED_SCENES["hollow depth"], Watcher(RANGES, BATCH)
    assert watch(hollow, 8_500, watcher) == {} and watcher.inversion == "due"
    slightly = Watcher(RANGES, BATCH)
    for images in range(STEP, 9_000, STEP):
        assert not slightly.judge(images, 0.1, measured(healthy_scene()) | {"bulge": -0.08})
    assert slightly.inversion == "due"
    watcher = Watcher.remembering(RANGES, BATCH, {**watcher.memory(), "inversion": "done"})
    assert watch(healthy_scene(), 30_000, watcher, start=8_500) == {}
    assert "hollow depth" in watch(hollow, 40_000, watcher, start=30_000)


def test_an_inverted_model_shows_almost_the_same_images_of_reliefs_pressed_in():
    model = derender.load("rendered-faces-64").requires_grad_()
    images = torch.from_numpy(faces.generate(4, seed=1).images) / 255
    optimiser = torch.optim.Adam(model.parameters(), lr=0)
    model.render(model.decode(model.encode(images))).image.sum().backward()
    optimiser.step()
    average = optimiser.state[model.nets["light"].decoder.linear.weight]["exp_avg"]
    before, scene = average.clone(), model.decompose(images)
    watching.invert(model, optimiser)
    inverted = model.decompose(images)
    torch.testing.assert_close(average, before * torch.tensor([1.0, 1, -1, -1])[:, None])
    assert measured(inverted)["bulge"] == pytest.approx(-measured(scene)["bulge"], abs=0.01)
    torch.testing.assert_close(inverted.camera[:, :2], -scene.camera[:, :2])
    apart = (model.render(inverted).image - model.render(scene).image)[..., 16:48, 16:48]
    assert apart.abs().mean() < 0.05
    watching.invert(model, optimiser)
    torch.testing.assert_close(model.decompose(images).depth, scene.depth)


def test_light_from_all_sides_keeps_its_signs():
    model = Derenderer.from_preset("small", seed=0, renderer="sh", width=4, light_width=4)
    before = [model.nets[name].decoder.linear.weight.clone() for name in ("light", "camera")]
    watching.invert(model, torch.optim.Adam(model.parameters()))
    light, camera = (model.nets[name].decoder.linear.weight for name in ("light", "camera"))
    assert torch.equal(light, before[0]) and torch.equal(camera[:2], -before[1][:2])


def test_large_batches_are_given_as_many_updates_not_as_many_images():
    torn = FAILED_SCENES["torn depth"]
    assert watch(torn, 70_000, Watcher(RANGES, 4 * BATCH)) == {}
    for images, batch in ((18_500, BATCH), (74_000, 4 * BATCH), (18_500, 2)):
        assert "torn depth" in watch(torn, images, Watcher(RANGES, batch))


def test_a_failure_that_passes_is_forgiven():
    watcher = Watcher(RANGES, BATCH)
    watch(FAILED_SCENES["view at its bound"], 6_000, watcher)
    assert watcher.uneasy
    assert watch(healthy_scene(), 20_000, watcher, start=6_000) == {}
    assert not watcher.uneasy


def test_a_watcher_goes_on_from_its_memory():
    failed = FAILED_SCENES["view at its bound"]
    first = Watcher(RANGES, BATCH)
    assert watch(failed, 7_000, first) == {}
    second = Watcher.remembering(RANGES, BATCH, first.memory())
    (finding,) = second.judge(9_000, 0.1, measured(failed))
    assert finding.sign == "view at its bound"


@pytest.mark.parametrize(
    "memory", [{"averages": {"bulge": "0"}}, {"on_since": [3]}, {"last_images": None}, {"uneasy_since": 3}]
)
def test_a_memory_that_no_watcher_gave_is_refused(memory):
    with pytest.raises(ValueError, match="does not hold what the collapse detector remembers"):
        Watcher.remembering(RANGES, BATCH, memory)


COLLAPSING = ["image_size=32", "width=4", "light_width=4", "batch_size=16", "perceptual=none", "images=4000"]
COLLAPSING += ["curvature_weight=0", "learning_rate=2e-2", "warmup_images=0", "pictures=0", "seed=3"]
SOONER = 16  # by how much the clock of the watcher is faster in a real collapse


@pytest.fixture(scope="module")
def generated() -> ImageSet:
    pixels = faces.generate(40, image_size=32, seed=0).images
    return ImageSet(images=pixels, files=tuple(f"{i:04d}.png" for i in range(40)))


def test_a_real_collapse_is_caught_while_its_loss_still_falls(generated, tmp_path, monkeypatch):
    for name in ("PERSISTENCE_IMAGES", "MEMORY_IMAGES"):
        monkeypatch.setattr(watching, name, getattr(watching, name) / SOONER)
    signs = [
        replace(sign, grace_images=sign.grace_images // SOONER, usual_images=sign.usual_images // SOONER)
        for sign in SIGNS
    ]
    monkeypatch.setattr(watching, "SIGNS", tuple(signs))
    monkeypatch.setattr(loop, "LOG_EVERY_STEPS", 8)
    result = train(resolve("small", COLLAPSING), generated, tmp_path / "run")
    assert result.stopped == "collapse" and result.images < 4_000
    results = {finding.sign for finding in result.findings if finding.fatal}
    assert results & {"saturated depth", "torn depth", "view at its bound"}
    rows = read_metrics(tmp_path / "run")
    errors = [row["l1"] for row in rows if row["kind"] == "train"]
    assert errors[-1] < 0.7 * errors[0]  # the images look better all the while
    assert results <= set(rows[-1])


def test_the_last_good_state_is_kept_whatever_the_interval(generated, tmp_path, monkeypatch):
    """With the intervals of the preset, and a sign that is on from image 400 on."""
    judge = Watcher.judge

    def ill(watcher: Watcher, images: int, *rest):
        judge(watcher, images, *rest)
        watcher.uneasy = images > 400
        return (Finding("a sign", "of collapse", "stop", True),) if images >= 704 else ()

    monkeypatch.setattr(Watcher, "judge", ill)
    run = tmp_path / "run"
    result = train(resolve("small", [*COLLAPSING, "learning_rate=1e-4", "batch_size=32"]), generated, run)
    assert (result.stopped, result.images) == ("collapse", 704)
    assert [row["images"] for row in read_metrics(run) if row["kind"] == "validation"] == [320]
    assert json.loads((run / "checkpoints/last/state.json").read_text())["state"]["images"] == 320
    assert derender.load(run).image_size == 32
