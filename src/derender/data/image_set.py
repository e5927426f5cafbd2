"""From any source to one array of decoded images with their labels: ``read_images``; and its split.

A stream of samples is decoded in order on every core. What is known to fit lies in memory. Everything else is
appended to a cache file, decoded once, and mapped into memory: training has random access.

A split into train, validation and test is the same on every machine. Files are put in the order of a hash of
their name and the seed, and that order is cut. An image added later moves only those few that lie at a cut.
With groups (identities), whole groups are ordered and cut: no person is on two sides.
"""

import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, nullcontext
from dataclasses import asdict, dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import PIL
import torch
from jaxtyping import Float, Shaped, UInt8
from torch import Tensor

from derender.data.cache import cache_folder, read_cache, write_cache
from derender.data.image import FITS, READER_VERSION, Unreadable, quiet_pillow
from derender.data.layouts.layout import Labels, missing, text_column
from derender.data.opening import open_images
from derender.data.source import Skipped
from derender.data.stream import Decoded, Progress, Stream, column_of, decoded, estimated_total, kinds_of
from derender.storage.places import counted, require_known, suggestion

MEMORY_LIMIT_BYTES = 2 << 30  # larger sets (175,000 images of 64 x 64) lie in a memory-mapped file


@dataclass(frozen=True)
class Split:
    """Three disjoint, sorted arrays of row numbers that together are all rows."""

    train: np.ndarray
    validation: np.ndarray
    test: np.ndarray


def split_indices(
    files: int | Sequence[str], fractions: tuple[float, float, float] = (0.8, 0.1, 0.1), *, seed: int = 0,
    groups: Sequence[object] | np.ndarray | None = None,
) -> Split:  # fmt: skip
    """Split rows, given by their file names (or only their number), in these fractions.

    Without groups the three counts are the fractions of the total, made whole. With groups, each cut is the
    one between groups that comes nearest. A group "" or NaN is unknown: such rows stand alone.
    """
    if any(not 0 <= fraction <= 1 for fraction in fractions) or abs(sum(fractions) - 1) > 1e-6:
        raise ValueError(f"split fractions must be three numbers in 0..1 that add up to 1, got {fractions}")
    names = [str(row) for row in range(files)] if isinstance(files, int) else list(files)
    keys = names
    if groups is not None:
        if len(groups) != len(names):
            raise ValueError(f"expected one group for each of {len(names)} images, got {len(groups)}")
        rows = zip(names, groups, strict=True)
        keys = [f"file {name}" if str(one) in ("", "nan") else f"group {one}" for name, one in rows]
    digests = [hashlib.sha256(f"{seed}\0{key}".encode(errors="surrogateescape")).hexdigest() for key in keys]
    exact = len(names) * np.array(fractions)
    counts = (exact + 1e-9).astype(int)
    largest_remainders = np.argsort(counts - exact, kind="stable")[: len(names) - counts.sum()]
    counts[largest_remainders] += 1
    _, group, sizes = np.unique(digests, return_inverse=True, return_counts=True)
    ends = np.cumsum([0, *sizes])
    cuts = [int(np.abs(ends - end).argmin()) for end in np.cumsum(counts)[:2]]
    part = np.searchsorted(cuts, group, side="right")
    return Split(*(np.flatnonzero(part == place) for place in range(3)))


@dataclass(frozen=True)
class Duplicate:
    """An image with exactly the pixels of an earlier one, at the size both were read in."""

    file: str
    first: str


@dataclass(frozen=True)
class ImageSet:
    """Decoded images, their labels, and what was left out.

    Attributes:
        images: (N, 3, S, S) RGB; a memory map for large sets.
        files: the name of each image, relative to the source.
        labels: columns by name, one value per image ("" / NaN / -1 where unknown).
        layout: the name of the layout they were read by ("utkface", "classes", "folder", ...).
        skipped: files that could not be read, with reasons.
        duplicates: files with the very pixels of an earlier one; not in ``images`` unless copies were kept.
        partition: the owners' own split of each image ("train", "validation", "test", ...), or None.
        source: what was read.
        terms: on what terms the owners of a published set give it, in a few words.
    """

    images: UInt8[np.ndarray, "n 3 h w"]
    files: tuple[str, ...]
    labels: Labels = field(default_factory=dict)
    layout: str = "folder"
    skipped: tuple[Skipped, ...] = ()
    duplicates: tuple[Duplicate, ...] = ()
    partition: np.ndarray | None = None
    source: str = ""
    terms: str = ""

    def __post_init__(self) -> None:
        if self.images.dtype != np.uint8:
            raise ValueError(f"images must be bytes (uint8) of 0..255, got {self.images.dtype}: convert them")
        for name, column in {"files": self.files, "partition": self.partition, **self.labels}.items():
            if column is not None and len(column) != len(self.images):
                raise ValueError(f"{len(self.images)} images, but {len(column)} values in {name!r}")

    def __len__(self) -> int:
        return len(self.files)

    def select(self, indices: Shaped[np.ndarray, " k"] | list[int] | slice) -> "ImageSet":
        """The same set with only these rows: numbers, a true/false mask, or a slice.

        A slice shares the images' memory; other choices copy them.
        """
        rows = np.arange(len(self))[indices]
        return replace(
            self,
            images=self.images[indices],
            files=tuple(self.files[row] for row in rows),
            labels={name: column[rows] for name, column in self.labels.items()},
            partition=None if self.partition is None else self.partition[rows],
        )

    def label(self, name: str) -> np.ndarray:
        """One column of labels; an unknown name is an error that names those there are."""
        if name not in self.labels:
            near = suggestion(name, self.labels)
            known = f"it has {', '.join(self.labels)}" if self.labels else "it has no labels"
            raise ValueError(f"{self.source} ({self.layout}) has no label {name!r}{near}; {known}")
        return self.labels[name]

    def require(self, minimum: int, purpose: str = "training") -> "ImageSet":
        """The set itself if it holds enough images; otherwise an error that says so."""
        if len(self) < minimum:
            result = "only one image was" if len(self) == 1 else f"only {len(self)} images were"
            left_out = len(self.skipped) + len(self.duplicates)
            note = f" ({left_out} more were unreadable or identical copies)" if left_out else ""
            needs = f"{purpose} needs {minimum:,} images or more"
            raise ValueError(f"{needs}, and {result} found in {self.source}{note}; add images")
        return self

    def describe(self) -> str:
        """One line: how many images, of which layout, what was left out."""
        parts = [f"{counted(len(self), 'images')} from {self.source} ({self.layout})"]
        parts += [f"{len(self.skipped):,} skipped"] if self.skipped else []
        if self.duplicates:
            verb = "kept" if {row.file for row in self.duplicates} <= set(self.files) else "dropped"
            parts.append(f"{len(self.duplicates):,} identical copies {verb}")
        unknown = {name: int(missing(column).sum()) for name, column in self.labels.items()}
        partly = [f"{name} unknown for {count:,}" for name, count in unknown.items() if count]
        if len(partly) > 3:
            partly[2:] = [f"{len(partly) - 2} more labels in part unknown"]
        return ", ".join([*parts, *partly])

    __repr__ = describe


def read_images(
    source: str | Path | Stream, image_size: int, *, dataset: str = "auto", subset: str | None = None,
    fit: str = "crop", keep_duplicates: bool = False, limit: int | None = None,
    cache: str | Path | None = None, memory_limit_bytes: int = MEMORY_LIMIT_BYTES,
    workers: int | None = None, progress: Progress | None = None,
) -> ImageSet:  # fmt: skip
    """Read every image of a source at ``image_size`` x ``image_size``.

    Args:
        source: a folder, zip, image, table of paths, shards or Hugging Face data set, also ``PATH::SUBSET``
            (data/opening.py). Or an open stream, which stays open, and whose part and limit are its own.
        image_size: side of the square images, in pixels.
        dataset: the layout's name, or "auto" to recognise it.
        subset: a part of the data set ("train", "test_gt", a sub-folder); rendered sets: "train" by default.
        fit: what becomes of images that are not square: "crop" to the centre, "pad" with white, "stretch".
        keep_duplicates: keep all of identical images and not only the first; they are listed in any case.
        limit: read at most so many images, evenly spaced in the sorted list; of a stream the first.
        cache: a folder to cache decoded images in, whatever their size. None caches streams and sets above
            ``memory_limit_bytes`` in the user's cache folder (``DERENDER_CACHE`` names another), and has
            others in memory.
        workers: threads; by default one for each core.
        progress: called with (done, total); of a stream the total is an estimate.
    """
    if not 1 <= image_size <= 4096:
        raise ValueError(f"image_size must be in 1..4096 pixels, got {image_size}")
    if limit is not None and limit < 1:
        raise ValueError(f"limit must be 1 or more, got {limit}")
    require_known("fit", fit, FITS)
    how = {"dataset": dataset, "subset": subset, "limit": limit}
    with (
        nullcontext(source) if isinstance(source, Stream) else open_images(source, **how) as stream,
        closing(decoded(stream, image_size, fit=fit, workers=workers)) as chunks,
        quiet_pillow(),
    ):
        result = _Found(keep_duplicates)

        def kept() -> Iterator[np.ndarray]:
            for chunk in chunks:
                yield np.array([one.pixels for one in chunk if result.add(one)], np.uint8)
                if progress is not None:
                    done = chunk[-1].number + 1
                    progress(done, estimated_total(done, chunk[-1].share, stream.limit))
            if not result.rows:
                where, skipped = f"{stream.source} ({stream.layout})", result.skipped
                first = f"the first is {skipped[0].file!r}: {skipped[0].reason}" if skipped else ""
                none = f"none of the {len(skipped):,} images in {where} can be read; {first}"
                raise ValueError(none if skipped else f"no image in {where}: it is empty")

        count = None if stream.table is None else len(stream.table.files)
        if cache is None and count is not None and count * 3 * image_size**2 <= memory_limit_bytes:
            images = np.empty((count, 3, image_size, image_size), np.uint8)
            for row, pixels in enumerate(chain.from_iterable(kept())):
                images[row] = pixels
            return _joined(stream, images[: len(result.rows)], result.content())
        settings = (READER_VERSION, stream.layout, image_size, fit, keep_duplicates, limit or stream.limit)
        made_of = repr((settings, PIL.__version__, stream.identity()))
        fingerprint = hashlib.sha256(made_of.encode()).hexdigest()
        name = re.sub(r"[^\w.-]+", "-", stream.source.rpartition("/")[2])[:40]  # for people
        told_apart = hashlib.sha256(repr((stream.place, settings)).encode("utf-8", "backslashreplace"))
        folder = cache_folder() if cache is None else Path(cache)
        file = folder / f"{name}-{told_apart.hexdigest()[:16]}.pictures"
        if (cached := read_cache(file, fingerprint, image_size)) is None:
            write_cache(file, fingerprint, image_size, kept(), result.content)
            if (cached := read_cache(file, fingerprint, image_size)) is None:
                raise OSError(f"decoded images could not be read back from {file}; check the disk")
        if progress is not None:
            progress(len(cached[0]), len(cached[0]))
        return _joined(stream, *cached)


def as_float(images: UInt8[np.ndarray, "*n 3 h w"] | UInt8[Tensor, "*n 3 h w"]) -> Float[Tensor, "*n 3 h w"]:
    """Images of 0..255 as a float32 tensor of 0..1."""
    tensor = torch.from_numpy(np.array(images)) if isinstance(images, np.ndarray) else images
    return tensor.to(torch.float32) / 255


@dataclass
class _Found:
    """What is known after each image: the rows, without their pixels, and what is left out."""

    keep_duplicates: bool
    rows: list[Decoded] = field(default_factory=list)
    skipped: list[Skipped] = field(default_factory=list)
    copies: list[Duplicate] = field(default_factory=list)
    seen: dict[bytes, str] = field(default_factory=dict)  # the first file of each digest

    def add(self, one: Decoded) -> bool:
        """Note an image; whether it is to be kept."""
        if isinstance(one.outcome, Unreadable):
            self.skipped.append(Skipped(one.file, str(one.outcome)))
            return False
        if one.outcome in self.seen:
            self.copies.append(Duplicate(one.file, self.seen[one.outcome]))
            if not self.keep_duplicates:
                return False
        self.seen.setdefault(one.outcome, one.file)
        self.rows.append(one._replace(pixels=None))
        return True

    def content(self) -> dict[str, Any]:
        """Everything, as JSON has it."""
        kinds, partition = kinds_of(one.labels for one in self.rows), [one.partition for one in self.rows]
        return {
            "files": [one.file for one in self.rows],
            "skipped": list(map(asdict, self.skipped)),
            "duplicates": list(map(asdict, self.copies)),
            "labels": {name: [kinds[name], [one.labels.get(name) for one in self.rows]] for name in kinds},
            "partition": partition if any(partition) else None,
        }


def _joined(stream: Stream, images: np.ndarray, content: Mapping[str, Any]) -> ImageSet:
    """The rows with their labels: those of the stream's table, or those that came with each."""
    files, partition = tuple(content["files"]), content["partition"]
    if stream.table is None:
        labels = {name: column_of(values, kind) for name, (kind, values) in content["labels"].items()}
        partition = None if partition is None else text_column(partition)
    else:
        row_of = {file: row for row, file in enumerate(stream.table.files)}
        table = stream.table.select(np.array([row_of[file] for file in files], np.int64))
        labels, partition = table.labels, table.partition
    skipped = (*stream.passed_over, *(Skipped(**row) for row in content["skipped"]))
    copies = tuple(Duplicate(**row) for row in content["duplicates"])
    result = (images, files, labels, stream.layout, skipped, copies, partition)
    return ImageSet(*result, source=stream.source, terms=stream.terms)
