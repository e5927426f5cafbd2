"""The step: its terms, who gets which gradient, which factor is perturbed; the template start; chunks."""

from contextlib import nullcontext
from functools import partial
from pathlib import Path

import pytest
import torch
from torch import nn

from derender.model import Derenderer
from derender.objectives.reconstruction import masked_l1, photometric_loss, relief
from derender.objectives.self_features import SelfFeatures
from derender.render import render_scene
from derender.training.config import ObjectiveSettings, TrainConfig, resolve
from derender.training.derender_task import DerenderTask
from derender.training.run_folder import RunFolder
from derender.training.step import cycle_loss, fill_uncovered, own_share, perturb_one_factor, training_step
from derender.training.task import Step, compute_step

PLAIN = ObjectiveSettings(perceptual="none", curvature_weight=0.0, raised_weight=0.0)
TEMPLATE = PLAIN.model_copy(update={"template_share": 0.1, "release_share": 0.2})


@pytest.fixture(scope="module")
def model() -> Derenderer:
    return Derenderer.from_preset("small", seed=0, image_size=32, width=8, light_width=4)


@pytest.fixture
def images(generator) -> torch.Tensor:
    return torch.rand(6, 3, 32, 32, generator=generator)


def test_reconstruction_terms_are_the_losses_of_scene_and_twin(model, images, generator):
    result = training_step(model, images, PLAIN, None, generator)
    scene = model.decompose(images)
    straight, twin = model.render(scene), model.render(model.mirror(scene))
    confidence = model.confidence(images)
    covered = straight.mask * twin.mask
    expected = photometric_loss(straight.image, images, covered, confidence.photometric)
    flipped = photometric_loss(twin.image, images, covered, confidence.photometric_flip)
    torch.testing.assert_close(result.terms["photometric"], expected.detach())
    torch.testing.assert_close(result.terms["photometric_flip"], 0.5 * flipped.detach())
    torch.testing.assert_close(result.terms["l1"], masked_l1(straight.image, images, covered).detach())
    torch.testing.assert_close(result.total, expected + 0.5 * flipped)


def test_every_weighted_term_appears_only_when_asked_for(model, images, generator):
    asked = {"smoothness": {"smoothness_weight": 0.1}, "curvature": {"curvature_weight": 1.0}}
    loocc, asked["raised"] = {"loocc": "light+camera"}, {"raised_weight": 1.0}
    asked |= {"loocc": loocc, "cycle": {**loocc, "cycle_weight": 1.0}}
    plain = set(training_step(model, images, PLAIN, None, generator).terms)
    assert plain == {"photometric", "photometric_flip", "l1"}
    for name, change in asked.items():
        terms = training_step(model, images, PLAIN.model_copy(update=change), None, generator).terms
        assert name in terms
        assert terms[name] > 0


def test_the_mean_surface_is_raised_along_rows_and_columns_and_then_left_alone(images, generator):
    model = Derenderer.from_preset("small", seed=0, image_size=32, width=8, light_width=4)
    objective = PLAIN.model_copy(update={"photometric_weight": 1e-9, "raised_weight": 1.0})
    optimiser, before = torch.optim.Adam(model.parameters(), lr=3e-3), 0.0
    for _ in range(30):
        result = training_step(model, images, objective, None, generator)
        optimiser.zero_grad()
        result.total.backward()
        optimiser.step()
        before = before or result.terms["raised"].item()
    missing = (0.1 - relief(result.scene.depth.detach(), border=1).mean(dim=0)).clamp(min=0).sum()
    assert result.terms["raised"].item() == pytest.approx(missing.item(), abs=1e-6)
    assert before > 0.1 and missing < 0.02


def test_leaning_objects_are_seen_from_their_lean_on_average(model, images, generator):
    ranges = model.settings.ranges.model_copy(update={"lean_deg": 35.0})
    leaning = Derenderer.seeded(model.settings.model_copy(update={"ranges": ranges}), 0)
    result = training_step(leaning, images, PLAIN, None, generator)
    pitch = leaning.decompose(images).camera[:, 0].detach()
    products = (pitch[:, None] * pitch)[~torch.eye(6, dtype=torch.bool)]
    torch.testing.assert_close(result.terms["lean"], 10 * products.mean())
    unweighted = PLAIN.model_copy(update={"lean_weight": 0.0})
    assert "lean" not in training_step(leaning, images, unweighted, None, generator).terms


@pytest.mark.parametrize("kind", ["light", "light+camera", "all"])
def test_exactly_the_chosen_factor_of_each_picture_is_changed(model, images, kind, generator):
    objective = ObjectiveSettings(loocc=kind)
    scene = model.decompose(images).detach()
    perturbed, chosen = perturb_one_factor(model, scene, objective, generator)
    for row, index in enumerate(chosen.tolist()):
        for i, factor in enumerate(model.factors):
            before, after = (s.parameters[factor.parameter][row] for s in (scene, perturbed))
            assert torch.equal(before, after) == (i != index)


def test_uncovered_pixels_take_the_colour_of_the_pictures_edge():
    picture = torch.full((1, 3, 4, 4), 0.25)
    picture[:, :, 1:3, 1:3] = 1.0
    rendered, mask = torch.ones(1, 3, 4, 4), torch.ones(1, 4, 4)
    mask[0, :, 0] = 0
    filled = fill_uncovered(rendered, mask, picture)
    assert torch.equal(filled[..., 0], torch.full((1, 3, 4), 0.25))
    assert torch.equal(filled[..., 1:], rendered[..., 1:])


def test_cycle_loss_is_zero_on_what_the_codes_say_and_grows_with_the_difference(model, images):
    objective = ObjectiveSettings(loocc="light+camera")
    codes = model.embed(images)
    scene = model.decode(codes)
    assert cycle_loss(model, codes, scene, objective).item() == pytest.approx(0, abs=1e-6)
    turned = scene.with_parameters(camera=scene.camera + 0.1)
    assert cycle_loss(model, codes, turned, objective).item() == pytest.approx(0.1, rel=1e-3)
    light_only = ObjectiveSettings(loocc="light")
    assert cycle_loss(model, codes, turned, light_only).item() == pytest.approx(0, abs=1e-6)


def test_cycle_loss_trains_the_encoders_not_the_scene(model, images):
    model.zero_grad(set_to_none=True)
    codes = {name: code.detach() for name, code in model.embed(images).items()}
    scene = model.decompose(images)
    turned = scene.with_parameters(camera=scene.camera + 0.1)
    cycle_loss(model, codes, turned, ObjectiveSettings(loocc="light+camera")).backward()
    assert model.nets["camera"].decoder.linear.weight.grad.abs().sum() > 0
    assert all(parameter.grad is None for parameter in model.nets["geometry"].parameters())


def test_bf16_networks_leave_geometry_in_float32(model, images, generator):
    def precision():
        return torch.autocast("cpu", torch.bfloat16)

    exact = training_step(model, images, PLAIN, None, generator)
    mixed = training_step(model, images, PLAIN, None, generator, precision)
    assert mixed.scene.depth.dtype == mixed.rendering.image.dtype == mixed.total.dtype == torch.float32
    assert abs(mixed.terms["l1"] - exact.terms["l1"]) < 0.02


@pytest.mark.parametrize(("done", "own"), [(0, 0), (0.09, 0), (0.1, 0), (0.2, 0.5), (0.3, 1), (1, 1)])
def test_maps_are_shared_and_then_released_along_a_line(done, own):
    assert own_share(TEMPLATE, done) == pytest.approx(own)


def test_a_shared_template_leaves_cameras_and_lights_their_own(model, images, generator):
    scene = training_step(model, images, TEMPLATE, None, generator, own=0.0).scene
    for shared in (scene.depth, scene.albedo):
        torch.testing.assert_close(shared, shared[:1].expand_as(shared))
    apart = model.decompose(images)
    torch.testing.assert_close(scene.camera, apart.camera)
    torch.testing.assert_close(scene.light, apart.light)
    assert not torch.allclose(apart.albedo[0], apart.albedo[1])
    shape = TEMPLATE.model_copy(update={"template_albedo": False})
    only_shape = training_step(model, images, shape, None, generator, own=0.0).scene
    torch.testing.assert_close(only_shape.depth, scene.depth)
    torch.testing.assert_close(only_shape.albedo, apart.albedo)


def test_the_step_follows_the_run_and_validation_does_not(model, images, generator):
    task = DerenderTask(TrainConfig(objective=TEMPLATE))
    none = torch.zeros(0, 3, 32, 32, dtype=torch.uint8)
    module = Step(model, task.losses(model, RunFolder(Path()), none, print))

    def depth(done):
        return compute_step(module, images, generator, nullcontext, done).scene.depth

    assert (depth(0)[0] == depth(0)[1]).all()
    torch.testing.assert_close(depth(None), model.decompose(images).depth)
    torch.testing.assert_close(depth(0.3), depth(None))
    assert (depth(None)[0] != depth(None)[1]).any()


OBJECTIVE = ObjectiveSettings(loocc="all", cycle_weight=1.0, smoothness_weight=0.1)
FEATURES = SelfFeatures((4, 8, 8))


@pytest.fixture
def exactly(monkeypatch):
    """The whole step in float64, where rounding cannot hide a difference."""
    monkeypatch.setattr(torch.Tensor, "float", torch.Tensor.double)
    settings = resolve("small", ["image_size=32", "width=8", "light_width=4"]).model
    return Derenderer.seeded(settings, 0, renderer=partial(render_scene, backend="reference")).double()


def losses_and_gradients(model: nn.Module, images: torch.Tensor, own: float, chunks: int):
    model.zero_grad(set_to_none=True)
    noise = torch.Generator().manual_seed(3)
    result = training_step(model, images, OBJECTIVE, FEATURES.double(), noise, own=own, chunks=chunks)
    result.total.backward()
    return result.terms, {name: p.grad for name, p in model.named_parameters() if p.grad is not None}


@pytest.mark.parametrize("own", [1.0, 0.3])
def test_a_batch_in_chunks_has_the_losses_and_gradients_of_the_whole(exactly, generator, own):
    images = torch.rand(6, 3, 32, 32, generator=generator, dtype=torch.float64)
    terms, gradients = losses_and_gradients(exactly, images, own, 1)
    assert {"perceptual", "perceptual_flip", "loocc", "cycle", "l1"} <= terms.keys()
    for chunks in (3, 4):
        in_parts, same = losses_and_gradients(exactly, images, own, chunks)
        assert in_parts.keys() == terms.keys()
        for name in terms:
            torch.testing.assert_close(in_parts[name], terms[name], rtol=1e-10, atol=1e-14, msg=name)
        assert same.keys() == gradients.keys()
        for name, gradient in gradients.items():
            scale = gradient.abs().max().clamp(min=1e-12)
            assert (same[name] - gradient).abs().max() <= 1e-9 * scale, name
