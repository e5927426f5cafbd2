"""Masked L1 and PSNR: closed forms, masks, and the mean picture as the control."""

import numpy as np
import pytest
import torch

from derender.evaluation import evaluate_reconstruction, mean_picture, reconstruction_scores
from derender.evaluation.reconstruction import component_count, from_components


def test_known_differences_give_known_scores():
    target = torch.full((2, 3, 4, 4), 0.5)
    prediction = target + torch.tensor([0.1, -0.01])[:, None, None, None]
    scores = reconstruction_scores(prediction, target, torch.ones(2, 4, 4))
    np.testing.assert_allclose(scores.l1_each, [0.1, 0.01], rtol=1e-5)
    np.testing.assert_allclose(scores.psnr_db_each, [20, 40], rtol=1e-5)
    assert scores.l1 == pytest.approx(0.055) and scores.psnr_db == pytest.approx(30)
    assert scores.coverage == 1 and scores.n_empty == 0


def test_a_copy_scores_the_best_value():
    target = torch.rand(2, 3, 4, 4)
    scores = reconstruction_scores(target, target, torch.ones(2, 4, 4))
    assert scores.l1 == 0 and scores.psnr_db == float("inf")


def test_only_the_mask_counts():
    target = torch.zeros(2, 3, 4, 4)
    prediction = target.clone()
    prediction[0, :, :2] = 0.2
    prediction[0, :, 2:] = torch.nan
    mask = torch.zeros(2, 4, 4)
    mask[0, :2] = 1
    scores = reconstruction_scores(prediction, target, mask)
    assert scores.l1 == pytest.approx(0.2) and scores.coverage == 0.25 and scores.n_empty == 1
    assert np.isnan(scores.l1_each[1]) and np.isnan(scores.psnr_db_each[1])
    with pytest.raises(ValueError, match="every mask is empty"):
        reconstruction_scores(prediction, target, torch.zeros(2, 4, 4))


class Copy(torch.nn.Module):
    """Gives the picture back, a little darker, in the upper half."""

    device = torch.device("cpu")

    def reconstruct(self, images):
        self.image = images * 0.9
        self.mask = torch.zeros(images[:, 0].shape)
        self.mask[:, :2] = 1
        return self


def test_the_mean_picture_is_scored_in_the_same_masks():
    images = np.random.default_rng(0).integers(0, 256, (7, 3, 4, 4), dtype=np.uint8)
    result = evaluate_reconstruction(Copy(), images, batch_size=3)
    floats = images / 255
    assert result.model.l1 == pytest.approx(0.1 * floats[:, :, :2].mean(), rel=1e-5)
    mean = floats.mean(axis=0)
    assert result.mean_picture.l1 == pytest.approx(np.abs(floats - mean)[:, :, :2].mean(), rel=1e-5)
    black = evaluate_reconstruction(Copy(), images, mean=torch.zeros(3, 4, 4))
    assert black.mean_picture.l1 == pytest.approx(floats[:, :, :2].mean(), rel=1e-5)
    assert result.model.coverage == result.mean_picture.coverage == 0.5


def test_the_mean_of_many_pictures_is_exact_and_of_none_an_error():
    images = np.full((2500, 3, 2, 2), 255, np.uint8)
    images[:625] = 0
    np.testing.assert_allclose(mean_picture(images), 0.75)
    with pytest.raises(ValueError, match="no pictures"):
        mean_picture(images[:0])


def test_components_copy_what_lies_in_their_span():
    """Pictures of two varying numbers come back from two components or more, others only nearly."""
    generator = np.random.default_rng(0)
    basis, mixed = generator.uniform(0, 1, (2, 3, 4, 4)), generator.uniform(0, 1, (40, 2))
    images = (np.einsum("nk,kchw->nchw", mixed, basis) * 127).round().astype(np.uint8)
    again = from_components(images, images)
    assert again.shape == images.shape and component_count(40) == 10
    assert (again - torch.from_numpy(images / 255)).abs().max() < 0.01
    noise = generator.integers(0, 256, images.shape, dtype=np.uint8)
    assert (from_components(noise, images) - torch.from_numpy(noise / 255)).abs().mean() > 0.1
