"""Images with masks, divided into training and test images, and controls without a trained network.

Controls learn from the training images only. Faces are aligned, so the most frequent class at a place already
draws a face; principal components also hold its pose.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64, UInt8
from sklearn.decomposition import PCA

from derender.baselines.controls import flat_pixels
from derender.data import ImageSet, split_indices
from derender.evaluation.pixels import component_count, evenly

TEST_FRACTION = 0.2
_CHUNK = 512


@dataclass(frozen=True)
class SegmentationData:
    """(N, 3, S, S) RGB images with (N, S, S) masks of class numbers, and the names of the classes.

    ``train`` rows are learned from, ``test`` rows scored and no others ever. ``split`` is the rule in words;
    ``source`` and ``layout`` are of the data set.
    """

    images: UInt8[np.ndarray, "n 3 s s"]
    masks: UInt8[np.ndarray, "n s s"]
    classes: tuple[str, ...]
    train: Int64[np.ndarray, " l"]
    test: Int64[np.ndarray, " t"]
    split: str
    source: str = ""
    layout: str = ""

    def shares(self, rows: Int64[np.ndarray, " k"]) -> np.ndarray:
        """(C,) share of the pixels of these rows that each class has; adds up to 1."""
        counted = np.bincount(self.masks[rows].ravel(), minlength=len(self.classes))
        return counted / counted.sum()


def divide(
    images: ImageSet,
    masks: UInt8[np.ndarray, "n s s"],
    classes: Sequence[str],
    *,
    test_fraction: float = TEST_FRACTION,
    split_seed: int = 0,
    labelled: int | None = None,
) -> SegmentationData:
    """Choose training and test images of what ``read_masks`` gave.

    Where the data bring a partition, its "test" rows are tested, and its "train" rows (all others, where it
    has no "train") learn. Otherwise files are ordered by a hash of their name and ``split_seed``, and the
    last ``test_fraction`` of that order are tested. ``labelled`` limits the training images. ValueError:
    nothing to learn from or to test, more requested than there is, or a single class.
    """
    if not 0 < test_fraction < 1:
        raise ValueError(f"the tested share must lie between 0 and 1, got {test_fraction}")
    owners = images.partition
    if owners is not None and (owners == "test").any():
        test = np.flatnonzero(owners == "test")
        train = np.flatnonzero(owners == "train" if (owners == "train").any() else owners != "test")
        rule = "the data's own partition"
    else:
        split = split_indices(images.files, (1 - test_fraction, 0.0, test_fraction), seed=split_seed)
        train, test, rule = split.train, split.test, f"a hash of the files' names, seed {split_seed}"
    if len(train) < 2 or not len(test):
        raise ValueError(
            f"{images.source} leaves {len(train)} images to learn from and {len(test)} to test on: "
            "bring more images, or another test_fraction"
        )
    if labelled is not None:
        if not 2 <= labelled <= len(train):
            raise ValueError(
                f"labelled={labelled:,} training images, but there are {len(train):,}: choose 2 to that many"
            )
        train = np.sort(np.random.default_rng(split_seed).permutation(train)[:labelled])
    seen = np.unique(masks[train])
    if len(seen) < 2:
        raise ValueError(
            f"the {len(train):,} masks to learn from in {images.source} show one class only "
            f"({classes[int(seen[0])]}): segmentation needs two or more"
        )
    return SegmentationData(
        images.images, masks, tuple(classes), train, test, rule, images.source, images.layout
    )


def most_frequent_at_place(data: SegmentationData) -> np.ndarray:
    """(T, S, S): the class that most training masks have at this place; of two even ones the lower."""
    learned = data.masks[data.train]
    counts = np.stack([(learned == number).sum(axis=0) for number in range(len(data.classes))])
    return np.tile(counts.argmax(axis=0).astype(np.uint8), (len(data.test), 1, 1))


def by_components(data: SegmentationData) -> np.ndarray:
    """(T, S, S): the best class of a linear regression from the image's principal components at each place.

    64 components (a quarter of the training images, where that is fewer) of at most 2,000 training images.
    Scaling them would change nothing. Of two even classes the lower.
    """

    def described(rows: np.ndarray) -> np.ndarray:
        parts = np.array_split(rows, max(1, len(rows) // _CHUNK))
        codes = [pca.transform(flat_pixels(data.images[part])) for part in parts]
        return np.column_stack((np.ones(len(rows)), np.concatenate(codes)))

    fitted = flat_pixels(data.images[data.train[evenly(len(data.train))]])
    pca = PCA(component_count(len(data.train)), random_state=0).fit(fitted)
    learned = data.masks[data.train].reshape(len(data.train), -1)
    solver, tested = np.linalg.pinv(described(data.train)), described(data.test)
    best = np.zeros((len(data.test), learned.shape[1]), np.uint8)
    most = np.full(best.shape, -np.inf)
    for number in np.unique(learned).tolist():
        parts = (slice(start, start + _CHUNK) for start in range(0, len(learned), _CHUNK))
        favour = tested @ np.sum([solver[:, part] @ (learned[part] == number) for part in parts], axis=0)
        better = favour > most + 1e-9
        best[better], most[better] = number, favour[better]
    return best.reshape(len(best), *data.masks.shape[1:])


CONTROLS: Mapping[str, Callable[[SegmentationData], np.ndarray]] = {
    "each place's class": most_frequent_at_place,
    "PCA": by_components,
}
"""By row name."""
