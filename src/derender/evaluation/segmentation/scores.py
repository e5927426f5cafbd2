"""Mean intersection over union, that of the ten best classes, and pixel accuracy.

Source: Klinghoffer et al., ECCV 2022, Sec. 4.7 and Table 3. Pixels are counted by torchmetrics, picture by
picture, so that the same counts give the scores and their resamples. Counts are added up over all pictures
before they are divided. A class that no tested mask shows has no IoU and is left out of every mean, for every
answer alike: answering it still costs the classes whose pixels it takes. Leaves out boundary scores.
"""

from dataclasses import dataclass

import numpy as np
import torch

TOP = 10
SCORES = ("mean_iou", "top10_iou", "pixel_accuracy")
_CHUNK = 64


@dataclass(frozen=True)
class SegmentationScores:
    """How right answers are; all 0..1, best 1.

    Attributes:
        mean_iou: intersection over union, mean over the classes that the masks show.
        top10_iou: the same over the ten classes with the highest IoU of these very answers (all, where there
            are fewer); higher by selection alone.
        pixel_accuracy: share of right pixels; background, skin and hair decide it.
        class_iou: (C,) of each class; NaN for one that no mask shows.
    """

    mean_iou: float
    top10_iou: float
    pixel_accuracy: float
    class_iou: np.ndarray


def count_pixels(answers: np.ndarray, masks: np.ndarray, n_classes: int) -> np.ndarray:
    """(N, 3, C) int64: of each picture and class, pixels that are right, that are answered, that are there.

    Args:
        answers, masks: (N, H, W) class numbers below ``n_classes``.
        n_classes: C, two or more.
    """
    from torchmetrics.functional.classification import multiclass_stat_scores

    if answers.shape != masks.shape or not len(masks):
        raise ValueError(f"answers {answers.shape} and masks {masks.shape} must be alike, and one or more")
    found = []
    for start in range(0, len(masks), _CHUNK):
        given, truth = (
            torch.from_numpy(np.ascontiguousarray(part[start : start + _CHUNK])).long()
            for part in (answers, masks)
        )
        counts = multiclass_stat_scores(
            given, truth, n_classes, average=None, multidim_average="samplewise"
        ).numpy()
        right, wrongly, _, _, there = np.moveaxis(counts, -1, 0)
        found.append(np.stack([right, right + wrongly, there], axis=1))
    return np.concatenate(found)


def segmentation_scores(counts: np.ndarray) -> SegmentationScores:
    """The scores of (N, 3, C) counts of N pictures."""
    mean_iou, top, accuracy = resampled_scores(counts, np.ones((1, len(counts))))[0]
    return SegmentationScores(float(mean_iou), float(top), float(accuracy), _iou(counts.sum(axis=0)[None])[0])


def resampled_scores(counts: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """``SCORES`` on resamples: (B, 3).

    The ten best classes are those of all pictures, on every resample.

    Args:
        counts: (N, 3, C).
        weights: (B, N) how often each picture is drawn.
    """
    best = best_classes(counts)
    drawn = weights.astype(np.float64) @ counts.reshape(len(counts), -1)
    drawn = drawn.reshape(len(weights), *counts.shape[1:])
    iou = _iou(drawn)
    accuracy = drawn[:, 0].sum(axis=1) / drawn[:, 2].sum(axis=1)
    return np.column_stack((_mean_known(iou), _mean_known(iou[:, best]), accuracy))


def best_classes(counts: np.ndarray, number: int = TOP) -> np.ndarray:
    """The classes with the highest IoU over all pictures, best first; at most those that the masks show."""
    iou = _iou(counts.sum(axis=0)[None])[0]
    order = np.argsort(-np.nan_to_num(iou, nan=-1.0), kind="stable")
    return order[: min(number, int(np.isfinite(iou).sum()))]


def _iou(counts: np.ndarray) -> np.ndarray:
    """(B, C) intersection over union of (B, 3, C) counts; NaN for classes that are not there."""
    right, answered, there = np.moveaxis(counts.astype(np.float64), 1, 0)
    return np.divide(right, answered + there - right, out=np.full(right.shape, np.nan), where=there > 0)


def _mean_known(values: np.ndarray) -> np.ndarray:
    """Mean over the classes that are there; a resample of pictures always shows at least one."""
    known = np.isfinite(values)
    return np.where(known, values, 0).sum(axis=1) / known.sum(axis=1).clip(min=1)
