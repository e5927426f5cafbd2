"""What is measured of images: brightness, colour, near copies; what they share, and in what they vary.

Each image becomes a grid of 6 x 6 cells with the strength of edges in eight orientations (after Dalal and
Triggs, HOG, 2005). The mean of each row of cells is taken off, and the length is 1: images that look alike
however they are shifted sideways (noise, textures, sky over hills) then agree by 0. Edges do not care which
side of an outline is darker, so one kind of thing in many colours agrees.

View: how far an image is from its own mirror image, against how far it is from other images' mirror images.
Light: how much brighter the left of the image's middle is than the right. Light from the side moves its upper
and its lower half together, marks and noise do not: what the halves share is counted. Leaves out light from
above or below, views that differ by tilt alone, and more than two kinds of thing.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64, UInt8
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from derender.data.image import DECODER_ERRORS, quiet_pillow, upright_size
from derender.data.source import Source, evenly_spaced
from derender.data.stream import Progress

GREY_PX, TINY_PX = 32, 16  # sides of the grey images that show structure, and near copies

DARK, BRIGHT = 2, 253  # at or beyond these values of 255 a channel counts as clipped
COPY_CORRELATION = 0.98  # tiny grey images that correlate by this much or more are near copies
GROUPS = 12
CELLS, ORIENTATIONS = 6, 8
_CELL_PX = 5
_MIRRORED = [0, *range(ORIENTATIONS - 1, 0, -1)]
_MARGIN, _REACH = 0.02, 14  # of the axis of symmetry
_SPLITS, _SPLIT_COMPONENTS, _STARTS, _SMALLEST = 8, 16, 3, 5
_MIDDLE = slice(10, 22)  # of 32 pixels
_CHUNK = 256
_COLOURLESS = 4.0  # mean distance of the channels, in values of 255: below it no colour is seen
_BLANK = 2.0  # standard deviation of grey, in values of 255: below it there is nothing to see
_WEIGHTS = np.array([0.299, 0.587, 0.114], np.float32)
_COMPONENTS, _NEIGHBOURS, _SAMPLE = 12, 6, 4_000
_PAIRS_AT_ONCE = 65_536

Grey = Float32[np.ndarray, "n 32 32"]
Cells = Float32[np.ndarray, "n 6 6 8"]


@dataclass(frozen=True)
class Pixels:
    """One row for each image."""

    tiny: Float32[np.ndarray, "n 256"]  # grey images with mean 0 and length 1 (0 throughout for blank ones)
    clipped: Float32[np.ndarray, " n"]  # share of pixels that are black or white in every channel, 0..1
    colourless: Bool[np.ndarray, " n"]  # the image shows no colour
    blank: Bool[np.ndarray, " n"]  # the image shows one brightness only


@dataclass(frozen=True)
class Originals:
    """Sizes of a sample of files, in pixels, upright."""

    sampled: int
    median_short: int
    smallest_short: int
    largest_long: int
    smaller: float  # share, 0..1, of files with a short side below ``image_size``
    oblong: float  # share of those whose sides differ by more than a quarter
    image_size: int


@dataclass(frozen=True)
class JackknifeEstimate:
    """A value and its standard error, both in the measure's own unit."""

    value: float
    error: float = 0.0


@dataclass(frozen=True)
class SymmetryAxis:
    """The axis about which the mean image of edges is most symmetric."""

    offset: float  # from the middle, as a share of the width; right is positive
    correlation: float  # of the two sides, -1..1, best 1


def measure_pixels(images: UInt8[np.ndarray, "n 3 s s"], progress: Progress | None = None) -> Pixels:
    """Measure every image, in chunks of a mapped set; the side must be a multiple of 32 pixels."""
    parts = []
    for start in range(0, len(images), _CHUNK):
        chunk = np.asarray(images[start : start + _CHUNK])
        lightest, darkest = chunk.max(axis=1), chunk.min(axis=1)
        grey = shrunk(chunk)
        blank = grey.std(axis=(1, 2)) * 255 < _BLANK
        rows = _averaged(grey, TINY_PX).reshape(len(grey), -1)
        rows = rows - rows.mean(axis=1, keepdims=True)
        tiny = (rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-6)).astype(np.float32)
        tiny[blank] = 0
        clipped = ((lightest <= DARK) | (darkest >= BRIGHT)).mean(axis=(1, 2), dtype=np.float32)
        parts.append((tiny, clipped, (lightest - darkest).mean(axis=(1, 2)) < _COLOURLESS, blank))
        if progress is not None:
            progress(start + len(chunk), len(images))
    return Pixels(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def shrunk(images: UInt8[np.ndarray, "n 3 s s"]) -> Grey:
    """Grey images of 32 pixels, 0..1, each pixel the mean of those it stands for."""
    if images.shape[-1] % GREY_PX:
        raise ValueError(f"the images' side must be a multiple of {GREY_PX} pixels, got {images.shape[-1]}")
    return _averaged(np.tensordot(images.astype(np.float32), _WEIGHTS / 255, axes=(1, 0)), GREY_PX)


def _averaged(grey: Float[np.ndarray, "n h w"], side: int) -> Float[np.ndarray, "n t t"]:
    block = grey.shape[-1] // side
    return grey.reshape(len(grey), side, block, side, block).mean(axis=(2, 4))


def near_copy_groups(tiny: Float32[np.ndarray, "n d"]) -> Int64[np.ndarray, " n"]:
    """For each image the first image of its group; itself where it has no earlier near copy.

    Two images are near copies if their tiny grey versions correlate by ``COPY_CORRELATION`` or more. Rows
    have length 1, or 0 for blank images, which count as copies. Candidates come from a k-d tree over the
    leading principal components, in which none are farther apart than in full. Groups are connected pairs.
    Leaves out colour, mirrored copies, and copies cropped otherwise.
    """
    sample = tiny[evenly_spaced(len(tiny), _SAMPLE)]
    covariance = np.cov(sample, rowvar=False) if len(sample) > 1 else np.eye(tiny.shape[1])
    places = (tiny @ np.linalg.eigh(covariance)[1][:, -_COMPONENTS:]).astype(np.float32)
    group = standing = np.arange(len(tiny))
    while len(standing) > 1:
        merged = standing[_merged(tiny[standing], places[standing])]
        if (merged == standing).all():
            break
        first = np.arange(len(tiny))
        first[standing] = merged
        group, standing = first[group], np.unique(merged)
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
    return np.unique(label, return_index=True)[1][label]


def measure_originals(source: Source, files: tuple[str, ...], image_size: int) -> Originals | None:
    """Read the headers of at most 1,000 files, evenly spaced; None if none is readable."""
    sizes = []
    with quiet_pillow():
        for row in evenly_spaced(len(files), 1_000):
            with suppress(*DECODER_ERRORS):
                sizes.append(sorted(upright_size(source.read(files[row]))))
    if not sizes:
        return None
    short, long = np.array(sizes).T
    pixels = int(np.median(short)), int(short.min()), int(long.max())
    shares = float((short < image_size).mean()), float((long > 1.25 * short).mean())
    return Originals(len(sizes), *pixels, *shares, image_size)


def jackknife(measure: Callable[[Int64[np.ndarray, " k"]], float], count: int) -> JackknifeEstimate:
    """``measure(rows)`` on all rows, and its standard error from leaving out one of 12 groups at a time.

    Rows are dealt to the groups in turn and count as independent. Where images come in families (many of one
    person) the true error is larger. Source: Shao and Tu, The Jackknife and Bootstrap (1995), chapter 2.3.
    """
    if count < 2 * GROUPS:
        raise ValueError(f"a jackknife over {GROUPS} groups needs {2 * GROUPS} rows or more, got {count}")
    rows = np.arange(count)
    left = np.array([measure(rows[rows % GROUPS != group]) for group in range(GROUPS)])
    variance = (GROUPS - 1) / GROUPS * np.sum((left - left.mean()) ** 2)
    return JackknifeEstimate(float(measure(rows)), float(np.sqrt(variance)))


def edge_cells(grey: Grey) -> Cells:
    """Strength of edges by cell and orientation (unsigned, square root of the gradient), not normalised."""
    down = grey[:, 2:, 1:-1] - grey[:, :-2, 1:-1]
    right = grey[:, 1:-1, 2:] - grey[:, 1:-1, :-2]
    strength = np.sqrt(np.hypot(right, down))
    place = np.mod(np.arctan2(down, right), np.pi) * (ORIENTATIONS / np.pi)
    cells = np.empty((len(grey), CELLS, CELLS, ORIENTATIONS), np.float32)
    for orientation in range(ORIENTATIONS):  # shared linearly by the two nearest
        away = np.abs(place - orientation)
        share = np.maximum(1 - np.minimum(away, ORIENTATIONS - away), 0)
        blocks = (strength * share).reshape(len(grey), CELLS, _CELL_PX, CELLS, _CELL_PX)
        cells[..., orientation] = blocks.sum(axis=(2, 4))
    return cells


def structure_of(cells: Cells) -> Cells:
    """Each image's edges less the mean of their row of cells, scaled to length 1."""
    return _of_length_one(cells - cells.mean(axis=2, keepdims=True))


def _of_length_one(cells: Cells) -> Cells:
    return cells / np.maximum(np.sqrt((cells**2).sum(axis=(1, 2, 3), keepdims=True)), 1e-6)


def mirrored(cells: Float[np.ndarray, "*n 6 6 8"]) -> Float[np.ndarray, "*n 6 6 8"]:
    """The same of the mirror images."""
    return cells[..., ::-1, :][..., _MIRRORED]


def agreement(structure: Cells) -> float:
    """Mean cosine between two different images: 0 nothing in common (or less, by chance), 1 all alike."""
    rows = structure.reshape(len(structure), -1).astype(np.float64)
    total = rows.sum(axis=0)
    return float((total @ total - (rows**2).sum()) / (len(rows) * (len(rows) - 1)))


def symmetry(structure: Cells) -> float:
    """Agreement with other images' mirror images over agreement, both unbiased: about -1..1, best 1."""
    return _to_others(structure) / max(agreement(structure), 1e-3)


def view_variety(structure: Cells) -> float:
    """Mean distance to the own mirror image over that to another's: 0 all frontal, 1 from everywhere."""
    return float(own_mirror_distance(structure).mean() / max(1 - _to_others(structure), 1e-9))


def own_mirror_distance(structure: Cells) -> Float[np.ndarray, " n"]:
    """1 - cosine between each image's structure and that of its mirror image, 0..2."""
    return 1 - (structure * mirrored(structure)).sum(axis=(1, 2, 3), dtype=np.float64)


def _to_others(structure: Cells) -> float:
    """Mean cosine between images and other images' mirror images."""
    count, total = len(structure), structure.sum(axis=0, dtype=np.float64)
    own = (1 - own_mirror_distance(structure)).sum()
    return float(((total * mirrored(total)).sum() - own) / (count * (count - 1)))


def frame_filled(structure: Cells) -> float:
    """Share of the image covered by mean structure, 0..1: (sum of energy)^2 / (cells x sum of squares)."""
    mean = structure.mean(axis=0, dtype=np.float64)
    chance = ((structure**2).mean(axis=(0, 3)) - (mean**2).mean(axis=2)) / (len(structure) - 1)
    energy = np.clip((mean**2).mean(axis=2) - chance, 0, None)  # less that of so few images
    return float(energy.sum() ** 2 / max(CELLS**2 * float((energy**2).sum()), 1e-18))


def side_light(grey: Grey) -> Float[np.ndarray, "n 2"]:
    """(left - right) / (left + right) of the middle's upper and lower half, -1..1; above 0: lit from left."""
    left, right = np.moveaxis(_averaged(grey[:, _MIDDLE, _MIDDLE].astype(np.float64), 2), 2, 0)
    return (left - right) / (left + right + 0.02)


def light_variety(sides: Float[np.ndarray, "n 2"]) -> float:
    """Standard deviation of side light that both halves share; 0 (or less, by chance): all lit alike."""
    upper, lower = (np.clip(half, *np.quantile(half, (0.01, 0.99))) for half in sides.T)
    shared = float(np.cov(upper, lower)[0, 1])
    return float(np.sign(shared) * np.sqrt(abs(shared)))


def symmetry_axis(grey: Grey) -> SymmetryAxis:
    """Look for an axis in steps of half a pixel, up to 7 pixels away; it has to beat the middle by 0.02."""
    right, down = np.gradient(grey, axis=2), np.gradient(grey, axis=1)
    mean = np.sqrt(np.hypot(right, down)).mean(axis=0, dtype=np.float64)
    width = mean.shape[1]
    result: dict[int, float] = {}
    for twice in range(-_REACH, _REACH + 1):  # twice the distance, in pixels of the small image
        part = mean[:, max(0, twice) : min(width, width + twice)]
        part = part - part.mean(axis=1, keepdims=True)
        result[twice] = float((part * part[:, ::-1]).sum() / max(float((part**2).sum()), 1e-12))
    best = max(result, key=lambda twice: (result[twice] - _MARGIN * (twice != 0), -abs(twice)))
    return SymmetryAxis(best / 2 / width, result[best])


def likeness(structure: Cells) -> Float[np.ndarray, " n"]:
    """Cosine of each image with the mean direction of the others; about 0 for a stranger among them."""
    rows = structure.reshape(len(structure), -1).astype(np.float64)
    with_others = (rows @ rows.sum(axis=0) - (rows**2).sum(axis=1)) / (len(rows) - 1)
    return with_others / np.sqrt(max(agreement(structure), 1e-4))


def split_in_two(
    structure: Cells, generator: np.random.Generator
) -> tuple[JackknifeEstimate, Float[np.ndarray, " n"]] | None:
    """Kinship of the two most different groups, and how clearly each image is in one (negative) or the other.

    Kinship is agreement across the groups over agreement within them: 1 one kind, 0 nothing shared; the
    median over random splits, with their standard deviation as its error. Structure is made blind to left and
    right first (a car seen from either side is one kind). k-means splits half of the images in two; the other
    half is dealt out and judged. None where no split leaves both groups large enough to judge.
    """
    from sklearn.cluster import KMeans
    from sklearn.decomposition import PCA

    blind = _of_length_one(structure + mirrored(structure))
    rows = blind.reshape(len(blind), -1)
    kinships, place = [], np.zeros(len(blind))
    for _ in range(_SPLITS):
        order = generator.permutation(len(blind))
        fit, judged = order[::2], order[1::2]
        seed = int(generator.integers(2**31))
        space = PCA(min(_SPLIT_COMPONENTS, len(fit)), svd_solver="full").fit(rows[fit])
        means = KMeans(2, init="random", n_init=_STARTS, random_state=seed)
        first, second = means.fit(space.transform(rows[fit])).cluster_centers_
        place = space.transform(rows) @ (second - first) - (second @ second - first @ first) / 2
        groups = blind[judged][place[judged] <= 0], blind[judged][place[judged] > 0]
        if min(map(len, groups)) < _SMALLEST:
            continue
        across = float((groups[0].mean(axis=0) * groups[1].mean(axis=0)).sum())
        within = max(agreement(groups[0]), 1e-3) * max(agreement(groups[1]), 1e-3)
        kinships.append(across / np.sqrt(within))
    if len(kinships) < _SPLITS // 2:
        return None
    kinship = JackknifeEstimate(float(np.median(kinships)), float(np.std(kinships)))
    return kinship, place / max(float(place.std()), 1e-9)
