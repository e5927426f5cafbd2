"""What needs no comparison of what images show: brightness, colour, near copies, sizes of the files.

One pass over all images works in chunks, so that a memory-mapped set is never in memory whole; what is kept
is 1.1 KB an image. Greys are 0.299 R + 0.587 G + 0.114 B of the values as stored (ITU-R BT.601).
"""

import io
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int64, Shaped, UInt8
from PIL import Image
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from derender.data.image import DECODER_ERRORS, quiet_pillow
from derender.data.source import Source

GREY_PX = 32
"""Side of the grey images that structure and variety are measured on."""

TINY_PX = 16
"""Side of the grey images that near copies are found by."""

DARK, BRIGHT = 2, 253
"""At or beyond these values of 255 a channel counts as clipped."""

COPY_CORRELATION = 0.98
"""Tiny grey images that correlate by this much or more are near copies."""

_CHUNK = 256
_COLOURLESS = 4.0  # mean distance of the channels, in values of 255: below it no colour is seen
_BLANK = 2.0  # standard deviation of grey, in values of 255: below it there is nothing to see
_WEIGHTS = np.array([0.299, 0.587, 0.114], np.float32)
_COMPONENTS, _NEIGHBOURS, _SAMPLE = 12, 6, 4_000
_HEADERS = 1_000
_PAIRS_AT_ONCE = 65_536


@dataclass(frozen=True)
class Pixels:
    """One row for each image.

    Attributes:
        tiny: grey images with mean 0 and length 1 (0 throughout for blank ones).
        dark: share of pixels that are black in every channel, 0..1.
        bright: share of pixels that are white in every channel, 0..1.
        colourless: the image shows no colour.
        blank: the image shows one brightness only.
    """

    tiny: Float32[np.ndarray, "n 256"]
    dark: Float32[np.ndarray, " n"]
    bright: Float32[np.ndarray, " n"]
    colourless: Bool[np.ndarray, " n"]
    blank: Bool[np.ndarray, " n"]


def measure_pixels(
    images: UInt8[np.ndarray, "n 3 s s"], progress: Callable[[int, int], object] | None = None
) -> Pixels:
    """Measure every image; the side must be a multiple of 32 pixels."""
    parts = []
    for start in range(0, len(images), _CHUNK):
        chunk = np.asarray(images[start : start + _CHUNK])
        lightest, darkest = chunk.max(axis=1), chunk.min(axis=1)
        grey = shrunk(chunk, GREY_PX)
        blank = grey.std(axis=(1, 2)) * 255 < _BLANK
        tiny = _unit(_averaged(grey, TINY_PX).reshape(len(grey), -1))
        tiny[blank] = 0
        dark = (lightest <= DARK).mean(axis=(1, 2), dtype=np.float32)
        bright = (darkest >= BRIGHT).mean(axis=(1, 2), dtype=np.float32)
        parts.append((tiny, dark, bright, (lightest - darkest).mean(axis=(1, 2)) < _COLOURLESS, blank))
        if progress is not None:
            progress(start + len(chunk), len(images))
    return Pixels(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def shrunk(images: UInt8[np.ndarray, "n 3 s s"], side: int = GREY_PX) -> Float32[np.ndarray, "n t t"]:
    """Grey images of ``side`` pixels, 0..1, each pixel the mean of those it stands for."""
    if images.shape[-1] % side:
        raise ValueError(f"the images' side must be a multiple of {side} pixels, got {images.shape[-1]}")
    grey = np.tensordot(images.astype(np.float32), _WEIGHTS / 255, axes=(1, 0))
    return _averaged(grey, side)


def _averaged(grey: Float32[np.ndarray, "n h w"], side: int) -> Float32[np.ndarray, "n t t"]:
    block = grey.shape[-1] // side
    return grey.reshape(len(grey), side, block, side, block).mean(axis=(2, 4))


def _unit(rows: Shaped[np.ndarray, "n d"]) -> Float32[np.ndarray, "n d"]:
    centred = rows - rows.mean(axis=1, keepdims=True)
    length = np.linalg.norm(centred, axis=1, keepdims=True)
    return (centred / np.maximum(length, 1e-6)).astype(np.float32)


def near_copy_groups(tiny: Float32[np.ndarray, "n d"]) -> Int64[np.ndarray, " n"]:
    """For each image the first image of its group; itself where it has no earlier near copy.

    Two images are near copies if their tiny grey versions (rows of length 1, or 0: blank images, which are
    copies of one another) correlate by ``COPY_CORRELATION`` or more: shifted by a pixel or two, brightened,
    compressed again. Candidates come from a k-d tree over the leading principal components, in which no two
    near copies can be farther apart than in full; groups are connected pairs, so that chains count as one.
    Leaves out colour, mirrored copies, and copies cropped otherwise.
    """
    group = np.arange(len(tiny))
    sample = tiny[np.unique(np.linspace(0, len(tiny) - 1, _SAMPLE).astype(int))]
    covariance = np.cov(sample, rowvar=False) if len(sample) > 1 else np.eye(tiny.shape[1])
    places = (tiny @ np.linalg.eigh(covariance)[1][:, -_COMPONENTS:]).astype(np.float32)
    standing = group.copy()
    while len(standing) > 1:
        merged = standing[_merged(tiny[standing], places[standing])]
        if (merged == standing).all():
            break
        new_first = np.arange(len(tiny))
        new_first[standing] = merged
        group = new_first[group]
        standing = np.unique(merged)
    return group


def _merged(tiny: Float32[np.ndarray, "m d"], places: Float32[np.ndarray, "m k"]) -> Int64[np.ndarray, " m"]:
    """One round: pairs among each image's nearest, joined; the first row of each row's group."""
    reach = float(np.sqrt(2 - 2 * COPY_CORRELATION))
    near = min(_NEIGHBOURS + 1, len(tiny))
    _, other = KDTree(places).query(places, k=near, distance_upper_bound=reach * 1.001)
    first, second = np.repeat(np.arange(len(tiny)), near), other.reshape(-1)
    real = (second < len(tiny)) & (second != first)
    first, second = first[real], second[real]
    close = np.empty(len(first), bool)
    for start in range(0, len(first), _PAIRS_AT_ONCE):
        part = slice(start, start + _PAIRS_AT_ONCE)
        close[part] = ((tiny[first[part]] - tiny[second[part]]) ** 2).sum(axis=1) <= reach**2
    pairs = coo_array((np.ones(close.sum(), np.int8), (first[close], second[close])), shape=(len(tiny),) * 2)
    label = connected_components(pairs, directed=False)[1]
    earliest = np.full(label.max() + 1, len(tiny))
    np.minimum.at(earliest, label, np.arange(len(tiny)))
    return earliest[label]


@dataclass(frozen=True)
class Originals:
    """Sizes of a sample of files, in pixels, as stored (EXIF orientation not applied).

    Attributes:
        sampled: how many headers were read.
        median_short, smallest_short, largest_long: short and long sides.
        smaller: share of files whose short side is below ``image_size``, 0..1.
        oblong: share of files whose sides differ by more than a quarter, 0..1.
        image_size: what ``smaller`` is about.
    """

    sampled: int
    median_short: int
    smallest_short: int
    largest_long: int
    smaller: float
    oblong: float
    image_size: int


def measure_originals(
    source: Source, files: tuple[str, ...], image_size: int, sample: int = _HEADERS
) -> Originals | None:
    """Read the headers of at most ``sample`` files, evenly spaced; None if none is readable."""
    sizes = []
    with quiet_pillow():
        for row in np.unique(np.linspace(0, len(files) - 1, min(sample, len(files))).astype(int)):
            try:
                with Image.open(io.BytesIO(source.read(files[row]))) as opened:
                    sizes.append(sorted(opened.size))
            except DECODER_ERRORS:
                continue
    if not sizes:
        return None
    short, long = np.array(sizes).T
    return Originals(
        sampled=len(sizes),
        median_short=int(np.median(short)),
        smallest_short=int(short.min()),
        largest_long=int(long.max()),
        smaller=float((short < image_size).mean()),
        oblong=float((long > 1.25 * short).mean()),
        image_size=image_size,
    )
