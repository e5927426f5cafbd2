"""How protocols run: one frozen value, whose fields are keywords of every protocol."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from derender.data import ImageSet
from derender.evaluation.bootstrap import RESAMPLES, once_and_resampled
from derender.evaluation.memory import Memory, memory_in
from derender.inputs import Progress, as_images

DEFAULT_FACTORS = ("geometry", "albedo")
COUNTS = (100, 500, 1_000)  # labelled rows that linear heads learn from: of these those that there are
NAMED = 5  # so many skipped images are named
FORMER = {"resample_count": "resamples", "memory": "cache"}  # former keywords, taken still, and today's


@dataclass(frozen=True)
class Options:
    """Keywords of every protocol; those on single images use seed, resamples, reading, cache and progress.

    Attributes:
        images: a data set or its address: of models, and of the controls. Without it there are no pixels, PCA
            and untrained encoder to compare with.
        factors: features to use, side by side; None means all.
        untrained_seeds: number of untrained encoders to average over.
        resamples: bootstrap resamples of the rows.
        seed: the first seed of every random choice: resamples, subsets, k-means, untrained encoders.
        keep_duplicates: of identical images keep every one.
        descriptors: also compare with Gradientfaces, HOG and LBP, alone and with mirror images, as tables
            of identity and class do.
        dataset, limit: how an address of images is read, see ``derender.inputs.as_images``.
        device: of models that are loaded here.
        cache: folder of cached results, "none" for none; by default the user's.
        progress: called with (done, total, description=..., unit=...).
        notes: sentences on the images read so far.
    """

    images: ImageSet | str | Path | None = None
    factors: Sequence[str] | None = DEFAULT_FACTORS
    untrained_seeds: int = 3
    resamples: int = RESAMPLES
    seed: int = 0
    keep_duplicates: bool = False
    descriptors: bool = False
    dataset: str = "auto"
    limit: int | None = None
    device: str = "auto"
    cache: Memory | str | Path | None = None
    progress: Callable[..., object] | None = None
    notes: list[str] = field(default_factory=list, init=False)
    _read: dict[int, ImageSet] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def of(cls, given: Mapping[str, Any], **defaults: Any) -> "Options":
        """The keywords of a call, over defaults of its protocol."""
        return cls(**{**defaults, **{FORMER.get(name, name): value for name, value in given.items()}})

    @cached_property
    def memory(self) -> Memory:
        """The cache."""
        return memory_in(self.cache)

    @property
    def chosen(self) -> tuple[str, ...] | None:
        """``factors`` as a tuple."""
        factors = (self.factors,) if isinstance(self.factors, str) else self.factors
        return None if factors is None else tuple(factors)

    @property
    def scoring(self) -> dict[str, Any]:
        """Keywords of comparisons on arrays: resamples, their seed and the cache."""
        return {"resample_count": self.resamples, "seed": self.seed, "memory": self.memory}

    def drawn(self, groups: np.ndarray | int) -> np.ndarray:
        """``once_and_resampled`` with these resamples and this seed."""
        return once_and_resampled(groups, self.resamples, self.seed)

    def seeds(self, count: int) -> tuple[int, ...]:
        """So many seeds, from ``seed`` on."""
        return tuple(range(self.seed, self.seed + count))

    def stage(self, description: str, unit: str = "images") -> Progress:
        """A callback of one stage's (done, total), which names the stage."""
        progress = self.progress or (lambda *_, **__: None)
        return lambda done, total: progress(done, total, description=description, unit=unit)

    def at(self, image_size: int, files: Sequence[str] | None = None) -> ImageSet:
        """The images at a side in pixels, read once for each; with ``files`` these, in this order."""
        if image_size not in self._read:
            assert self.images is not None
            how = {name: getattr(self, name) for name in ("dataset", "limit", "keep_duplicates")}
            result = as_images(self.images, image_size, **how, progress=self.stage("reading"))
            if (side := result.images.shape[-1]) != image_size:
                fix = "give the address of the data set instead"
                raise ValueError(f"the images have {side} pixels a side and {image_size} are needed: {fix}")
            self.notes.append(result.describe())
            self.notes.extend(f"skipped {row.file}: {row.reason}" for row in result.skipped[:NAMED])
            if len(result.skipped) > NAMED:
                self.notes.append(f"and {len(result.skipped) - NAMED:,} more skipped")
            self._read[image_size] = result
        read = self._read[image_size]
        return read if files is None else aligned(read, files)


def aligned(images: ImageSet, files: Sequence[str]) -> ImageSet:
    """The images with these names, in this order."""
    if images.files == tuple(files):
        return images
    place = {file: row for row, file in enumerate(images.files)}
    if absent := [file for file in files if file not in place]:
        among = f"the images of {images.source} (first {absent[0]})"
        what = f"{len(absent)} of {len(files)} rows of the table are not among {among}"
        raise ValueError(f"{what}: give the data that the table was made from")
    return images.select(np.array([place[file] for file in files]))
