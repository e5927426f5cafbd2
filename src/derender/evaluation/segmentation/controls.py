"""Answers that no trained network gives: the most frequent class, that of each place, and a pixel's colour.

Each learns from the training rows only. Faces are aligned, so the class that is most frequent at a place
already draws a face; and skin, hair and background differ in colour.
"""

import numpy as np

from derender.evaluation.segmentation.pixels import SegmentationData

COLOUR_PIXELS = 20_000


def most_frequent(data: SegmentationData, seed: int = 0) -> np.ndarray:
    """(T, S, S): always the class with the most training pixels."""
    answer = np.uint8(data.shares(data.train).argmax())
    return np.full(data.masks[data.test].shape, answer, np.uint8)


def most_frequent_at_place(data: SegmentationData, seed: int = 0) -> np.ndarray:
    """(T, S, S): the class that most training masks have at this place; of two even ones the lower."""
    learned = data.masks[data.train]
    best, count = np.zeros(learned.shape[1:], np.uint8), np.zeros(learned.shape[1:], np.int64)
    for number in range(len(data.classes)):
        here = (learned == number).sum(axis=0)
        best[here > count] = number
        count = np.maximum(count, here)
    return np.broadcast_to(best, data.masks[data.test].shape).copy()


def by_colour(data: SegmentationData, seed: int = 0) -> np.ndarray:
    """(T, S, S): logistic regression from a pixel's red, green and blue alone, on 20,000 training pixels."""
    from sklearn.linear_model import LogisticRegression

    pixels_each = data.masks[0].size
    generator = np.random.default_rng(seed)
    drawn = generator.choice(
        len(data.train) * pixels_each, min(COLOUR_PIXELS, len(data.train) * pixels_each), replace=False
    )
    rows, places = data.train[drawn // pixels_each], drawn % pixels_each
    flat = data.images.reshape(len(data.images), 3, pixels_each)
    colours = _scaled(flat[rows, :, places])
    classes = data.masks.reshape(len(data.masks), pixels_each)[rows, places]
    if len(np.unique(classes)) == 1:
        return np.full(data.masks[data.test].shape, classes[0], np.uint8)
    regression = LogisticRegression(max_iter=1_000).fit(colours, classes)
    answers = [
        regression.predict(_scaled(flat[row].T)).reshape(data.masks[0].shape) for row in data.test.tolist()
    ]
    return np.stack(answers).astype(np.uint8)


def _scaled(colours: np.ndarray) -> np.ndarray:
    """Bytes as numbers in -2..2, where the regression's penalty is mild."""
    return colours.astype(np.float64) / 63.75 - 2


CONTROLS = {
    "each place's class": most_frequent_at_place,
    "pixel colour": by_colour,
    "most frequent class": most_frequent,
}
"""By row name; functions of (data, seed)."""
