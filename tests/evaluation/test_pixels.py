"""Masked L1, PSNR and SSIM: closed forms, masks, and the controls."""

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio

from derender.evaluation.pixels import (
    WINDOW,
    component_count,
    evaluate_reconstruction,
    from_components,
    masked_ssim,
    reconstruction_scores,
)


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
    """Gives the image back, a little darker, in the upper half."""

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


def test_components_copy_what_lies_in_their_span():
    """Images of two varying numbers come back from two components or more, others only nearly."""
    generator = np.random.default_rng(0)
    basis, mixed = generator.uniform(0, 1, (2, 3, 4, 4)), generator.uniform(0, 1, (40, 2))
    images = (np.einsum("nk,kchw->nchw", mixed, basis) * 127).round().astype(np.uint8)
    again = from_components(images, images)
    assert again.shape == images.shape and component_count(40) == 10
    assert (again - torch.from_numpy(images / 255)).abs().max() < 0.01
    noise = generator.integers(0, 256, images.shape, dtype=np.uint8)
    assert (from_components(noise, images) - torch.from_numpy(noise / 255)).abs().mean() > 0.1
    assert (from_components(images[:1], images[:1]) - torch.from_numpy(images[:1] / 255)).abs().max() < 1e-6


def pair(count: int = 2, height: int = 24, width: int = 29) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(count, 3, height, width, generator=generator)
    return (target + 0.2 * torch.rand(target.shape, generator=generator)).clamp(0, 1), target


def similarity(one: np.ndarray, other: np.ndarray) -> float:
    """SSIM of two windows of 11 x 11 pixels by its definition (Wang et al., 2004)."""
    weights = np.exp(-np.square(np.mgrid[-5:6, -5:6]).sum(axis=0) / (2 * 1.5**2))
    means = [np.average(x, weights=weights) for x in (one, other)]
    spreads = [np.average((x - m) ** 2, weights=weights) for x, m in zip((one, other), means, strict=True)]
    both = np.average((one - means[0]) * (other - means[1]), weights=weights)
    luminance = (2 * means[0] * means[1] + 0.01**2) / (means[0] ** 2 + means[1] ** 2 + 0.01**2)
    return luminance * (2 * both + 0.03**2) / (sum(spreads) + 0.03**2)


def test_with_a_full_mask_the_scores_are_those_of_their_definitions():
    prediction, target = pair()
    full, places = torch.ones(2, 24, 29), list(np.ndindex(3, 14, 19))
    scores = reconstruction_scores(prediction, target, full)
    for number, images in enumerate(zip(prediction.numpy(), target.numpy(), strict=True)):
        shown = ([x[row, top : top + 11, left : left + 11] for x in images] for row, top, left in places)
        expected = np.mean([similarity(*windows) for windows in shown])
        assert masked_ssim(prediction, target, full)[number].item() == pytest.approx(expected, abs=1e-5)
        psnr = peak_signal_noise_ratio(*images, data_range=1.0)
        assert scores.psnr_db_each[number] == pytest.approx(psnr, rel=1e-5)
    assert scores.ssim == pytest.approx(masked_ssim(prediction, target, full).mean().item(), rel=1e-6)


def test_what_lies_outside_the_mask_does_not_matter():
    prediction, target = pair()
    mask = torch.zeros(2, 24, 29)
    mask[:, 3:20, 2:25] = 1
    expected = masked_ssim(prediction, target, mask)
    for rubbish in (0.0, 7.0, float("nan")):
        dirty = [torch.where(mask[:, None] > 0, p, torch.tensor(rubbish)) for p in (prediction, target)]
        torch.testing.assert_close(masked_ssim(*dirty, mask), expected, rtol=1e-5, atol=1e-6)
    cut = [p[:, :, 3:20, 2:25] for p in (prediction, target)]
    torch.testing.assert_close(expected, masked_ssim(*cut, torch.ones(2, 17, 23)), rtol=1e-5, atol=1e-6)


def test_masks_too_small_for_a_window_have_no_score():
    prediction, target = pair()
    mask = torch.zeros(2, 24, 29)
    mask[0, : WINDOW - 1], mask[1] = 1, 1
    result = masked_ssim(prediction, target, mask)
    assert result.isnan().tolist() == [True, False]
    scores = reconstruction_scores(prediction, target, mask)
    assert scores.ssim == pytest.approx(result[1].item()) and scores.n_empty == 0
    assert masked_ssim(prediction[..., :8, :8], target[..., :8, :8], mask[..., 16:, 16:24]).isnan().all()
