"""What images have in common at the same place, in what they vary, and whether they are of one kind.

Each image becomes a grid of 6 x 6 cells with the strength of edges in eight orientations (after Dalal and
Triggs, Histograms of Oriented Gradients, 2005), the mean of its row of cells taken off, length 1. Taking
off rows is what distinguishes an object from a landscape: of images that look alike wherever they are
shifted sideways (noise, textures, sky over hills) nothing is left in common, so their agreement is 0 by
construction. Edges do not care which side of an outline is darker, so one kind of thing in many colours
agrees.

View: how far an image is from its own mirror image, against how far it is from other images' mirror images.
Things seen from the front only are nearly their own mirror images; a turned head or car is not. Light: how
much brighter the left of the image's middle is than the right, in its upper and its lower half; light from
the side moves both together, marks and noise do not, so what the halves share is counted. Leaves out light
from above or below, views that differ by tilt alone, and more than two kinds: three show as two of them
joined.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int64

GROUPS = 12
CELLS, ORIENTATIONS = 6, 8
_CELL_PX = 5
_MARGIN = 0.02
_MIRRORED = [0, *range(ORIENTATIONS - 1, 0, -1)]
_SPLITS, _COMPONENTS, _STARTS, _SMALLEST = 8, 16, 3, 5
_MIDDLE = slice(10, 16), slice(16, 22)  # of 32 pixels, on either side of the middle
_CLIP = 0.01  # share at each end that is drawn in before standard deviations are taken


@dataclass(frozen=True)
class JackknifeEstimate:
    """A value and its standard error, both in the measure's own unit."""

    value: float
    error: float = 0.0


def jackknife(
    measure: Callable[[Int64[np.ndarray, " k"]], float], count: int, groups: int = GROUPS
) -> JackknifeEstimate:
    """``measure(rows)`` on all rows, and its standard error from leaving out one group at a time.

    Rows are dealt to the groups in turn; they count as independent, so where images come in families (many
    of one person) the true error is larger. Source: Shao and Tu, The Jackknife and Bootstrap (1995),
    chapter 2.3.
    """
    if count < 2 * groups:
        raise ValueError(f"a jackknife over {groups} groups needs {2 * groups} rows or more, got {count}")
    rows = np.arange(count)
    left = np.array([measure(rows[rows % groups != group]) for group in range(groups)])
    variance = (groups - 1) / groups * np.sum((left - left.mean()) ** 2)
    return JackknifeEstimate(float(measure(rows)), float(np.sqrt(variance)))


def edge_cells(grey: Float32[np.ndarray, "n 32 32"]) -> Float32[np.ndarray, "n 6 6 8"]:
    """Strength of edges by cell and orientation (unsigned, square root of the gradient), not normalised."""
    down = grey[:, 2:, 1:-1] - grey[:, :-2, 1:-1]
    right = grey[:, 1:-1, 2:] - grey[:, 1:-1, :-2]
    strength = np.sqrt(np.hypot(right, down))
    place = np.mod(np.arctan2(down, right), np.pi) * (ORIENTATIONS / np.pi)
    lower = np.floor(place).astype(int) % ORIENTATIONS
    to_upper = (place - np.floor(place)).astype(np.float32)
    cells = np.empty((len(grey), CELLS, CELLS, ORIENTATIONS), np.float32)
    for orientation in range(ORIENTATIONS):
        is_lower, is_upper = lower == orientation, (lower + 1) % ORIENTATIONS == orientation
        share = is_lower * (1 - to_upper) + is_upper * to_upper
        blocks = (strength * share).reshape(len(grey), CELLS, _CELL_PX, CELLS, _CELL_PX)
        cells[..., orientation] = blocks.sum(axis=(2, 4))
    return cells


def structure_of(cells: Float32[np.ndarray, "n 6 6 8"]) -> Float32[np.ndarray, "n 6 6 8"]:
    """Each image's edges less the mean of their row of cells, scaled to length 1."""
    rest = cells - cells.mean(axis=2, keepdims=True)
    return rest / np.maximum(np.sqrt((rest**2).sum(axis=(1, 2, 3), keepdims=True)), 1e-6)


def mirrored(cells: Float[np.ndarray, "*n 6 6 8"]) -> Float[np.ndarray, "*n 6 6 8"]:
    """The same of the mirror images."""
    return cells[..., ::-1, :][..., _MIRRORED]


def agreement(structure: Float32[np.ndarray, "n 6 6 8"]) -> float:
    """Mean cosine between two different images: 0 nothing in common, 1 all alike.

    Unbiased, so it may fall below 0 by chance.
    """
    rows = structure.reshape(len(structure), -1).astype(np.float64)
    total = rows.sum(axis=0)
    return float((total @ total - (rows**2).sum()) / (len(rows) * (len(rows) - 1)))


def symmetry(structure: Float32[np.ndarray, "n 6 6 8"]) -> float:
    """Agreement between images and other images' mirror images, over agreement: about -1..1, best 1.

    Unbiased above and below, so that few images look no less symmetric than many; it may pass 1 by chance.
    """
    return _to_others(structure) / max(agreement(structure), 1e-3)


def view_variety(structure: Float32[np.ndarray, "n 6 6 8"]) -> float:
    """Mean distance to the own mirror image over that to another's: 0 all frontal, 1 from everywhere."""
    return float(own_mirror_distance(structure).mean() / max(1 - _to_others(structure), 1e-9))


def own_mirror_distance(structure: Float32[np.ndarray, "n 6 6 8"]) -> Float[np.ndarray, " n"]:
    """1 - cosine between each image's structure and that of its mirror image, 0..2."""
    return 1 - (structure * mirrored(structure)).sum(axis=(1, 2, 3), dtype=np.float64)


def _to_others(structure: Float32[np.ndarray, "n 6 6 8"]) -> float:
    """Mean cosine between images and other images' mirror images."""
    count, total = len(structure), structure.sum(axis=0, dtype=np.float64)
    own = (1 - own_mirror_distance(structure)).sum()
    return float(((total * mirrored(total)).sum() - own) / (count * (count - 1)))


def frame_filled(structure: Float32[np.ndarray, "n 6 6 8"]) -> float:
    """Share of the image that the mean structure covers, 0..1: (sum of energy)^2 / (cells x sum of squares).

    The energy that chance puts into a mean of so few images is taken off first.
    """
    mean = structure.mean(axis=0, dtype=np.float64)
    chance = ((structure**2).mean(axis=(0, 3)) - (mean**2).mean(axis=2)) / (len(structure) - 1)
    energy = np.clip((mean**2).mean(axis=2) - chance, 0, None)
    return float(energy.sum() ** 2 / max(CELLS**2 * float((energy**2).sum()), 1e-18))


def side_light(grey: Float32[np.ndarray, "n 32 32"]) -> Float[np.ndarray, "n 2"]:
    """(left - right) / (left + right) of the middle's upper and lower half, -1..1; above 0: lit from left."""
    low, high = _MIDDLE
    halves = []
    for rows in (low, high):
        left = grey[:, rows, low].mean(axis=(1, 2), dtype=np.float64)
        right = grey[:, rows, high].mean(axis=(1, 2), dtype=np.float64)
        halves.append((left - right) / (left + right + 0.02))
    return np.stack(halves, axis=1)


def light_variety(sides: Float[np.ndarray, "n 2"]) -> float:
    """Standard deviation of side light that both halves share; 0 (or less, by chance): all lit alike."""
    upper, lower = (np.clip(half, *np.quantile(half, (_CLIP, 1 - _CLIP))) for half in sides.T)
    shared = float(np.cov(upper, lower)[0, 1])
    return float(np.sign(shared) * np.sqrt(abs(shared)))


@dataclass(frozen=True)
class SymmetryAxis:
    """The axis about which the mean image of edges is most symmetric.

    Attributes:
        offset: its distance from the middle as a share of the width; right is positive.
        correlation: of the two sides about it, -1..1, best 1.
    """

    offset: float
    correlation: float


def symmetry_axis(grey: Float32[np.ndarray, "n 32 32"], reach: int = 14) -> SymmetryAxis:
    """Look for an axis in steps of half a pixel, at most ``reach`` of them to either side.

    An axis off the middle has to be better than the middle by 0.02.
    """
    right, down = np.gradient(grey, axis=2), np.gradient(grey, axis=1)
    mean = np.sqrt(np.hypot(right, down)).mean(axis=0, dtype=np.float64)
    mean -= mean.mean(axis=1, keepdims=True)
    width = mean.shape[1]
    found: dict[int, float] = {}
    for twice in range(-reach, reach + 1):  # twice the distance, in pixels of the small image
        part = mean[:, max(0, twice) : min(width, width + twice)]
        part = part - part.mean(axis=1, keepdims=True)
        found[twice] = float((part * part[:, ::-1]).sum() / max(float((part**2).sum()), 1e-12))
    best = max(found, key=lambda twice: (found[twice] - _MARGIN * (twice != 0), -abs(twice)))
    return SymmetryAxis(best / 2 / width, found[best])


def likeness(structure: Float32[np.ndarray, "n 6 6 8"]) -> Float[np.ndarray, " n"]:
    """Cosine of each image with the mean direction of the others; about 0 for a stranger among them.

    Where the images agree at all, each has sqrt(agreement) in the mean.
    """
    rows = structure.reshape(len(structure), -1).astype(np.float64)
    with_others = (rows @ rows.sum(axis=0) - (rows**2).sum(axis=1)) / (len(rows) - 1)
    return with_others / np.sqrt(max(agreement(structure), 1e-4))


@dataclass(frozen=True)
class Halves:
    """The two most different groups.

    Attributes:
        kinship: agreement across the groups over agreement within them; 1 one kind, 0 nothing shared. Median
            over random splits, with their standard deviation as its error.
        smaller: share of the images in the smaller group, 0..0.5.
        margin: how clearly each image is in one group (negative) or the other, in standard deviations.
    """

    kinship: JackknifeEstimate
    smaller: float
    margin: Float[np.ndarray, " n"]


def split_in_two(structure: Float32[np.ndarray, "n 6 6 8"], generator: np.random.Generator) -> Halves | None:
    """Judge the two most different groups; None where no split leaves both large enough to judge.

    Structure is made blind to left and right first (a car seen from either side is one kind), then split in
    two by k-means on half of the images; the other half is dealt out and judged.
    """
    from sklearn.cluster import KMeans
    from sklearn.decomposition import PCA

    blind = structure + mirrored(structure)
    blind = blind / np.maximum(np.sqrt((blind**2).sum(axis=(1, 2, 3), keepdims=True)), 1e-6)
    rows = blind.reshape(len(blind), -1)
    kinships, shares, place = [], [], np.zeros(len(blind))
    for _ in range(_SPLITS):
        order = generator.permutation(len(blind))
        fit, judged = order[::2], order[1::2]
        seed = int(generator.integers(2**31))
        space = PCA(min(_COMPONENTS, len(fit)), svd_solver="full").fit(rows[fit])
        how: dict[str, Any] = {"init": "random", "n_init": _STARTS, "random_state": seed}
        means = KMeans(2, **how).fit(space.transform(rows[fit]))
        first, second = means.cluster_centers_
        reduced = space.transform(rows)
        place = reduced @ (second - first) - (second @ second - first @ first) / 2
        groups = blind[judged][place[judged] <= 0], blind[judged][place[judged] > 0]
        if min(map(len, groups)) < _SMALLEST:
            continue
        across = float((groups[0].mean(axis=0) * groups[1].mean(axis=0)).sum())
        within = max(agreement(groups[0]), 1e-3) * max(agreement(groups[1]), 1e-3)
        kinships.append(across / np.sqrt(within))
        shares.append(min(map(len, groups)) / len(judged))
    if len(kinships) < _SPLITS // 2:
        return None
    kinship = JackknifeEstimate(float(np.median(kinships)), float(np.std(kinships)))
    return Halves(kinship, float(np.median(shares)), place / max(float(place.std()), 1e-9))
