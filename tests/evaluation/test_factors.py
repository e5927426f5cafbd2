"""Errors of albedo, light and camera: zero up to what no image can tell, known on closed forms."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from derender.data import GroundTruth
from derender.evaluation import albedo_error, evaluate_factors, light_error
from derender.scene import Scene
from derender.scene.camera import rotation_matrix


def cameras(count: int = 20, seed: int = 0, spread_rad: float = 0.3) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    rotation = spread_rad * torch.randn(count, 3, generator=generator)
    return torch.cat([rotation, torch.zeros(count, 3)], dim=1)


def turned(camera: torch.Tensor, about: torch.Tensor) -> torch.Tensor:
    """Cameras whose rotation is R @ about, as angles: R = Rz Ry Rx gives them back."""
    r = rotation_matrix(camera[:, :3].double()) @ about
    x, z = torch.atan2(r[:, 2, 1], r[:, 2, 2]), torch.atan2(r[:, 1, 0], r[:, 0, 0])
    angles = torch.stack([x, -torch.asin(r[:, 2, 0]), z], dim=1)
    return torch.cat([angles, camera[:, 3:].double()], dim=1).float()


def test_albedo_error_is_zero_up_to_scale_and_blind_outside_the_mask():
    albedo = torch.rand(3, 3, 6, 7, generator=torch.Generator().manual_seed(0))
    mask = torch.rand(3, 6, 7, generator=torch.Generator().manual_seed(1)) > 0.3
    scaled = albedo * torch.tensor([0.2, 1.0, 1.7])[:, None, None, None]
    dirty = torch.where(mask[:, None], scaled, torch.nan)
    assert albedo_error(dirty, albedo, mask).max() < 1e-7


def test_albedo_error_of_a_constant_is_the_standard_deviation_and_of_nothing_the_whole():
    albedo = torch.rand(2, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    mask = torch.ones(2, 8, 8, dtype=torch.bool)
    constant = albedo_error(torch.full_like(albedo, 0.3), albedo, mask)
    np.testing.assert_allclose(constant, albedo.flatten(1).std(dim=1, correction=0), rtol=1e-5)
    nothing = albedo_error(torch.zeros_like(albedo), albedo, mask)
    np.testing.assert_allclose(nothing, albedo.square().flatten(1).mean(dim=1).sqrt(), rtol=1e-5)
    assert albedo_error(albedo, albedo, ~mask).isnan().all()


def test_one_scale_for_all_pictures_forgives_one_scale_only():
    albedo = torch.rand(3, 3, 6, 7, generator=torch.Generator().manual_seed(0))
    mask = torch.ones(3, 6, 7, dtype=torch.bool)
    assert albedo_error(albedo * 0.4, albedo, mask, one_scale=True).max() < 1e-7
    scaled = albedo * torch.tensor([0.5, 1.0, 2.0])[:, None, None, None]
    power = albedo.double().square().sum(dim=(1, 2, 3))
    factor = torch.tensor([0.5, 1.0, 2.0])
    best = (factor * power).sum() / (factor.square() * power).sum()
    expected = (best * factor - 1).abs() * (power / (3 * 6 * 7)).sqrt()
    np.testing.assert_allclose(albedo_error(scaled, albedo, mask, one_scale=True), expected, rtol=1e-5)


def test_alignment_forgives_a_constant_turn_of_the_light_and_nothing_else():
    generator = torch.Generator().manual_seed(0)
    light = torch.cat([torch.zeros(30, 2), 0.4 * torch.randn(30, 2, generator=generator)], dim=1)
    still, turn = torch.zeros(30, 6), torch.zeros(30, 6)
    turn[:, :3] = torch.tensor([0.3, -0.5, 0.2])
    assert light_error(light, turn, light, still).mean_deg > 20
    assert light_error(light, turn, light, still, aligned=True).mean_deg < 1e-4
    mirrored = light * torch.tensor([1, 1, 1, -1])
    plain, aligned = (light_error(mirrored, still, light, still, aligned=a) for a in (False, True))
    assert 5 < aligned.mean_deg <= plain.mean_deg + 1e-6


def test_light_is_compared_in_the_frame_of_the_camera():
    """A light turned one way on an object turned back by as much is the same light."""
    light, camera = torch.zeros(1, 4), torch.zeros(1, 6)
    light[0, 3], camera[0, 1] = 0.3, -0.3
    frontal = torch.zeros(1, 4), torch.zeros(1, 6)
    assert light_error(light, camera, *frontal).mean_deg < 1e-5
    assert light_error(light, -camera, *frontal).mean_deg == pytest.approx(np.degrees(0.6), rel=1e-5)


class Oracle(torch.nn.Module):
    """A model that knows a scene; under plain ambient light its rendering is the albedo it knows."""

    image_size, device = 5, torch.device("cpu")

    def __init__(self, albedo, mask, light, camera):
        super().__init__()
        self.known, self.mask, self.done = Scene(torch.ones(len(light), 5, 5), albedo, light, camera), mask, 0

    def decompose(self, images):
        self.done += len(images)
        return self.known[self.done - len(images) : self.done]

    def render(self, scene):
        assert scene.light.tolist() == [[1, 0, 0, 0]] * len(scene)
        self.image, self.shown = scene.albedo, self.mask[self.done - len(scene) : self.done]
        return SimpleNamespace(image=scene.albedo, mask=self.shown)


def ground_truth() -> GroundTruth:
    rng = np.random.default_rng(0)
    light = np.concatenate([np.full((6, 2), 0.5), rng.uniform(-0.7, 0.7, (6, 2))], axis=1)
    images, depth, mask = np.zeros((6, 3, 5, 5), np.uint8), np.ones((6, 5, 5), "f"), np.ones((6, 5, 5), bool)
    albedo, light, camera = rng.random((6, 3, 5, 5), np.float32), light.astype(np.float32), cameras(6).numpy()
    return GroundTruth(images, depth, None, albedo, mask, light, camera, tuple("abcdef"), {})


def test_a_model_that_knows_the_truth_scores_zero_and_constants_do_not():
    truth = ground_truth()
    about = rotation_matrix(torch.tensor([0.0, 0.3, 0.0], dtype=torch.float64))
    values = [torch.as_tensor(v) for v in (truth.albedo, truth.mask, truth.light, truth.camera)]
    result = evaluate_factors(Oracle(values[0] / 2, values[1].float(), *values[2:]), truth, batch_size=4)
    ours, constant = result.model, result.constant
    assert ours.albedo < 1e-6 and ours.light < 1e-4 and ours.camera < 1e-4
    assert constant.albedo > 0.1 and constant.light == constant.aligned > 5 and constant.camera > 5
    turned_model = Oracle(*values[:3], turned(values[3], about))
    assert ours.albedo_global < 1e-6 < constant.albedo_global and ours.aligned < 1e-4
    with pytest.raises(ValueError, match="this ground truth has no camera: give a set that stores it"):
        evaluate_factors(turned_model, replace(truth, camera=None))
    elsewhere = evaluate_factors(turned_model, truth).model
    assert elsewhere.camera < 1e-4 and elsewhere.light > 5
