"""Answers that no trained network gives: the most frequent class, that of each place, a pixel's colour, and
the picture's principal components.

Each learns from the training rows only. Faces are aligned, so the class that is most frequent at a place
already draws a face; skin, hair and background differ in colour; and components tell how the face is turned.
"""

import numpy as np

from derender.evaluation.segmentation.pixels import SegmentationData

COLOUR_PIXELS = 20_000
COMPONENTS = 64
COMPONENT_PICTURES = 2_000
_CHUNK = 512


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


def by_components(data: SegmentationData, seed: int = 0) -> np.ndarray:
    """(T, S, S): the class that linear regression from the picture's principal components favours at a place.

    64 components (a quarter of the training pictures, where that is fewer) of at most 2,000 training
    pictures. Scaling them would change nothing. Of two even classes the lower.
    """
    from sklearn.decomposition import PCA

    learned = data.masks[data.train].reshape(len(data.train), -1)
    fitted = data.train[
        np.linspace(0, len(data.train) - 1, min(len(data.train), COMPONENT_PICTURES)).astype(int)
    ]
    count = max(1, min(COMPONENTS, len(data.train) // 4))
    pca = PCA(count, random_state=seed).fit(_flat(data, fitted))

    def described(rows: np.ndarray) -> np.ndarray:
        parts = np.array_split(rows, max(1, len(rows) // _CHUNK))
        found = np.concatenate([pca.transform(_flat(data, part)) for part in parts])
        return np.column_stack((np.ones(len(rows)), found))

    asked = described(data.test)
    solver = np.linalg.pinv(described(data.train))  # (1 + components, training pictures)
    best = np.zeros((len(data.test), learned.shape[1]), np.uint8)
    most = np.full(best.shape, -np.inf)
    for number in np.unique(learned).tolist():
        weights = sum(
            solver[:, start : start + _CHUNK] @ (learned[start : start + _CHUNK] == number)
            for start in range(0, len(learned), _CHUNK)
        )
        favour = asked @ np.asarray(weights)
        better = favour > most + 1e-9
        best[better], most[better] = number, favour[better]
    return best.reshape(len(best), *data.masks.shape[1:])


def _flat(data: SegmentationData, rows: np.ndarray) -> np.ndarray:
    """Pictures as rows of numbers in 0..1."""
    return data.images[rows].reshape(len(rows), -1).astype(np.float32) / 255


def _scaled(colours: np.ndarray) -> np.ndarray:
    """Bytes as numbers in -2..2, where the regression's penalty is mild."""
    return colours.astype(np.float64) / 63.75 - 2


CONTROLS = {
    "each place's class": most_frequent_at_place,
    "pixel colour": by_colour,
    "PCA": by_components,
    "most frequent class": most_frequent,
}
"""By row name; functions of (data, seed)."""
