"""What is segmented: pictures with masks, who learns and who is tested, and how often each class is seen."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64, UInt8

from derender.data import PictureSet, split_indices

TEST_FRACTION = 0.2


@dataclass(frozen=True)
class SegmentationData:
    """Pictures with a mask each, divided.

    Attributes:
        images: (N, 3, S, S) RGB bytes.
        masks: (N, S, S) class numbers.
        classes: the name of every class number.
        train: rows to learn from.
        test: rows to be tested on; no others are ever scored.
        split: how the two were told apart, in words.
    """

    images: UInt8[np.ndarray, "n 3 s s"]
    masks: UInt8[np.ndarray, "n s s"]
    classes: tuple[str, ...]
    train: Int64[np.ndarray, " l"]
    test: Int64[np.ndarray, " t"]
    split: str

    def shares(self, rows: Int64[np.ndarray, " k"]) -> np.ndarray:
        """(C,) share of the pixels of these rows that each class has; adds up to 1."""
        counted = np.bincount(self.masks[rows].ravel(), minlength=len(self.classes))
        return counted / counted.sum()


def divide(
    pictures: PictureSet,
    masks: UInt8[np.ndarray, "n s s"],
    classes: Sequence[str],
    *,
    test_fraction: float = TEST_FRACTION,
    split_seed: int = 0,
    labelled: int | None = None,
) -> SegmentationData:
    """Say who learns and who is tested.

    Where the data bring a partition, its "test" rows are tested, and its "train" rows (all others, where none
    is called so) learn. Otherwise files are ordered by a hash of their name and ``split_seed``, and the last
    of that order are tested.

    Args:
        pictures, masks, classes: as ``read_masks`` gives them.
        test_fraction: share of the pictures that is tested, where the data have no partition.
        split_seed: of the split and of the choice of ``labelled``.
        labelled: learn from so many pictures only; smaller numbers are part of larger ones. None means all.

    Raises:
        ValueError: nothing to learn from or to test, more asked for than there is, or a single class.
    """
    if not 0 < test_fraction < 1:
        raise ValueError(f"the tested share must lie between 0 and 1, got {test_fraction}")
    partition = pictures.partition
    if partition is not None and (partition == "test").any():
        test = np.flatnonzero(partition == "test")
        named = np.flatnonzero(partition == "train")
        train = named if len(named) else np.flatnonzero(partition != "test")
        told = "the data's own partition"
    else:
        split = split_indices(pictures.files, (1 - test_fraction, 0.0, test_fraction), seed=split_seed)
        train, test = split.train, split.test
        told = f"a hash of the files' names, seed {split_seed}"
    if len(train) < 2 or not len(test):
        raise ValueError(
            f"{pictures.source} leaves {len(train)} pictures to learn from and {len(test)} to test on: "
            "bring more pictures, or another --test-fraction"
        )
    if labelled is not None:
        if not 2 <= labelled <= len(train):
            raise ValueError(
                f"asked to learn from {labelled:,} pictures, there are {len(train):,}: ask for 2 to that many"
            )
        train = np.sort(np.random.default_rng(split_seed).permutation(train)[:labelled])
    seen = np.unique(masks[train])
    if len(seen) < 2:
        raise ValueError(
            f"the {len(train):,} masks to learn from in {pictures.source} show one class only "
            f"({classes[int(seen[0])]}): segmentation needs two or more"
        )
    return SegmentationData(pictures.images, masks, tuple(classes), train, test, told)
