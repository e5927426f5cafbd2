"""Scores against closed forms and torchmetrics; classes that are not there; resamples."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torchmetrics.functional.classification import multiclass_accuracy, multiclass_jaccard_index

from derender.evaluation.segmentation.compare import (
    COLUMNS,
    best_classes,
    class_iou,
    count_pixels,
    resampled_scores,
)


def scores(answers, masks, n_classes=4) -> SimpleNamespace:
    counts = count_pixels(np.asarray(answers), np.asarray(masks), n_classes)
    values = resampled_scores(counts, np.ones((1, len(counts))))[0]
    return SimpleNamespace(**dict(zip(COLUMNS, values, strict=True)), class_iou=class_iou(counts))


def test_a_class_that_no_mask_shows_is_left_out_for_every_answer():
    masks = np.array([[[0, 0], [1, 1]]], np.uint8)
    right, wrong = masks.copy(), np.array([[[0, 3], [1, 1]]], np.uint8)
    assert scores(right, masks).mean_iou == 1
    found = scores(wrong, masks)
    assert found.class_iou == pytest.approx([0.5, 1, np.nan, np.nan], nan_ok=True)
    assert found.mean_iou == 0.75 == found.top10_iou


def test_the_masks_themselves_score_best_and_shuffled_pixels_chance():
    """Answers dealt at random agree by the classes' shares p: accuracy sum p^2, IoU p / (2 - p)."""
    random = np.random.default_rng(2)
    share = np.array([0.6, 0.3, 0.1])
    masks = random.choice(3, (20, 64, 64), p=share).astype(np.uint8)
    best = scores(masks, masks, 3)
    assert (best.mean_iou, best.top10_iou, best.pixel_accuracy) == (1, 1, 1)
    found = scores(random.permutation(masks.ravel()).reshape(masks.shape), masks, 3)
    assert found.class_iou == pytest.approx(share / (2 - share), abs=0.01)
    assert found.pixel_accuracy == pytest.approx((share**2).sum(), abs=0.01)


def test_they_are_torchmetrics_own():
    random = np.random.default_rng(0)
    masks = random.integers(0, 19, (70, 6, 5)).astype(np.uint8)
    answers = np.where(random.random(masks.shape) < 0.5, masks, random.integers(0, 19, masks.shape))
    found = scores(answers.astype(np.uint8), masks, 19)
    given, truth = torch.from_numpy(answers).long(), torch.from_numpy(masks).long()
    each = multiclass_jaccard_index(given, truth, 19, average="none").numpy()
    assert found.class_iou == pytest.approx(each, abs=1e-6)
    assert found.mean_iou == pytest.approx(multiclass_jaccard_index(given, truth, 19).item(), abs=1e-6)
    assert found.top10_iou == pytest.approx(np.sort(each)[-10:].mean(), abs=1e-6)
    accuracy = multiclass_accuracy(given, truth, 19, average="micro").item()
    assert found.pixel_accuracy == pytest.approx(accuracy, abs=1e-6)


def test_resamples_are_scores_of_the_pictures_drawn_with_the_same_ten_classes():
    random = np.random.default_rng(1)
    masks = random.integers(0, 3, (6, 4, 4)).astype(np.uint8)
    answers = random.integers(0, 3, masks.shape).astype(np.uint8)
    counts, drawn = count_pixels(answers, masks, 4), [0, 0, 3, 5]
    weights = np.bincount(drawn, minlength=6)[None]
    found = scores(answers[drawn], masks[drawn])
    expected = [found.mean_iou, found.mean_iou, found.pixel_accuracy]
    assert resampled_scores(counts, weights)[0] == pytest.approx(expected)
    assert set(best_classes(counts)) == {0, 1, 2} and len(best_classes(counts, 2)) == 2
