"""SSIM inside a mask: torchmetrics' own where everything is covered, blind to what lies outside."""

import pytest
import torch
from torchmetrics.functional.image import (
    peak_signal_noise_ratio,
    structural_similarity_index_measure,
)

from derender.evaluation import reconstruction_scores
from derender.evaluation.structural_similarity import AT_A_TIME, WINDOW, masked_ssim


def pair(count: int = 2, height: int = 24, width: int = 29) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(count, 3, height, width, generator=generator)
    return (target + 0.2 * torch.rand(target.shape, generator=generator)).clamp(0, 1), target


def test_with_a_full_mask_the_scores_are_those_of_torchmetrics():
    prediction, target = pair()
    full = torch.ones(2, 24, 29)
    oracle = structural_similarity_index_measure(prediction, target, data_range=1.0, reduction="none")
    cropped = [
        p[..., 5:-5, 5:-5] for p in (prediction, target)
    ]  # torchmetrics blurs the border by reflection
    assert cropped[0].shape == (2, 3, 14, 19)
    whole = structural_similarity_index_measure(
        prediction, target, data_range=1.0, reduction="none", return_full_image=True
    )[1]
    expected = whole[..., 5:-5, 5:-5].mean(dim=(1, 2, 3))
    torch.testing.assert_close(masked_ssim(prediction, target, full).float(), expected, rtol=1e-4, atol=1e-5)
    assert (masked_ssim(prediction, target, full) - oracle).abs().max() < 0.05
    scores = reconstruction_scores(prediction, target, full)
    each = [
        peak_signal_noise_ratio(p, t, data_range=1.0).item() for p, t in zip(prediction, target, strict=True)
    ]
    assert scores.psnr_db_each.tolist() == pytest.approx(each, rel=1e-5)
    assert scores.ssim == pytest.approx(expected.mean().item(), rel=1e-4)


def test_a_copy_is_best_and_noise_is_near_nothing():
    prediction, target = pair()
    full = torch.ones(2, 24, 29)
    assert masked_ssim(target, target, full).tolist() == pytest.approx([1, 1], abs=1e-5)
    noise = torch.rand(target.shape, generator=torch.Generator().manual_seed(5))
    assert masked_ssim(noise, target, full).abs().max() < 0.2 < masked_ssim(prediction, target, full).min()


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


def test_many_pictures_score_as_each_by_itself():
    prediction, target = pair(count=AT_A_TIME + 3, height=12, width=13)
    mask = torch.ones(len(target), 12, 13)
    each = [masked_ssim(*(v[i : i + 1] for v in (prediction, target, mask))) for i in (0, 31, 32, 34)]
    found = masked_ssim(prediction, target, mask)[[0, 31, 32, 34]]
    torch.testing.assert_close(found, torch.cat(each), rtol=1e-5, atol=1e-6)


def test_masks_too_small_for_a_window_have_no_score():
    prediction, target = pair()
    mask = torch.zeros(2, 24, 29)
    mask[0, : WINDOW - 1], mask[1] = 1, 1
    found = masked_ssim(prediction, target, mask)
    assert found.isnan().tolist() == [True, False]
    scores = reconstruction_scores(prediction, target, mask)
    assert scores.ssim == pytest.approx(found[1].item()) and scores.n_empty == 0
    with pytest.raises(ValueError, match=r"11 pixels or more each way, got \(8, 8\)"):
        masked_ssim(prediction[..., :8, :8], target[..., :8, :8], mask[..., :8, :8])
