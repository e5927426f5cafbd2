"""The template start: who shares what, for how long, and what that asks of the camera."""

from contextlib import nullcontext

import pytest
import torch

from derender.model import Derenderer
from derender.training.config import ObjectiveSettings, TrainConfig
from derender.training.derender_task import DerenderStep
from derender.training.step import own_share, share_codes, training_step
from derender.training.task import compute_step

OBJECTIVE = ObjectiveSettings(perceptual="none", curvature_weight=0.0, template_share=0.1, release_share=0.2)


@pytest.mark.parametrize(("done", "own"), [(0, 0), (0.09, 0), (0.1, 0), (0.2, 0.5), (0.3, 1), (1, 1)])
def test_maps_are_shared_and_then_released_along_a_line(done, own):
    assert own_share(OBJECTIVE, done) == pytest.approx(own)


def test_only_the_named_codes_move_to_their_mean(generator):
    codes = {name: torch.randn(4, 8, generator=generator) for name in ("geometry", "light")}
    half = share_codes(codes, ["geometry"], 0.5)
    expected = (codes["geometry"] + codes["geometry"].mean(dim=0)) / 2
    torch.testing.assert_close(half["geometry"], expected)
    assert half["light"] is codes["light"]
    assert share_codes(codes, ["geometry"], 1.0) == codes


@pytest.fixture(scope="module")
def model() -> Derenderer:
    return Derenderer.from_preset("small", seed=0, image_size=32, width=8, light_width=4)


def test_a_shared_template_leaves_cameras_and_lights_their_own(model, generator):
    images = torch.rand(4, 3, 32, 32, generator=generator)
    scene = training_step(model, images, OBJECTIVE, None, generator, own=0.0).scene
    for shared in (scene.depth, scene.albedo):
        torch.testing.assert_close(shared, shared[:1].expand_as(shared))
    apart = model.decompose(images)
    torch.testing.assert_close(scene.camera, apart.camera)
    torch.testing.assert_close(scene.light, apart.light)
    assert not torch.allclose(apart.albedo[0], apart.albedo[1])


def test_the_step_follows_the_run_and_validation_does_not(model, generator):
    images = torch.rand(4, 3, 32, 32, generator=generator)
    module = DerenderStep(model, TrainConfig(objective=OBJECTIVE), None)

    def depth(done):
        return compute_step(module, images, generator, nullcontext, done).scene.depth

    assert (depth(0)[0] == depth(0)[1]).all()
    torch.testing.assert_close(depth(None), model.decompose(images).depth)
    torch.testing.assert_close(depth(0.3), depth(None))
    assert (depth(None)[0] != depth(None)[1]).any()
