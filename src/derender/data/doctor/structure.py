"""What pictures have in common at the same place, and whether that is symmetric, central and fills the frame.

Each picture becomes a grid of 6 x 6 cells with the strength of edges in eight orientations (after Dalal and
Triggs, Histograms of Oriented Gradients, 2005), the mean of its row of cells taken off, length 1. Taking off
rows is what tells an object from a landscape: of pictures that look alike wherever they are shifted sideways
(noise, textures, sky over hills) nothing is left in common, so their agreement is 0 by construction. Edges do
not care which side of an outline is darker, so one kind of thing in many colours agrees.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

CELLS, ORIENTATIONS = 6, 8
_CELL_PX = 5
_MARGIN = 0.02
_MIRRORED = [0, *range(ORIENTATIONS - 1, 0, -1)]


@dataclass(frozen=True)
class Axis:
    """The axis about which the mean picture of edges is most symmetric.

    Attributes:
        offset: its distance from the middle as a share of the width; right is positive.
        correlation: of the two sides about it, -1..1, best 1.
    """

    offset: float
    correlation: float


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
        share = (lower == orientation) * (1 - to_upper) + (
            (lower + 1) % ORIENTATIONS == orientation
        ) * to_upper
        blocks = (strength * share).reshape(len(grey), CELLS, _CELL_PX, CELLS, _CELL_PX)
        cells[..., orientation] = blocks.sum(axis=(2, 4))
    return cells


def structure_of(cells: Float32[np.ndarray, "n 6 6 8"]) -> Float32[np.ndarray, "n 6 6 8"]:
    """Each picture's edges less the mean of their row of cells, scaled to length 1."""
    rest = cells - cells.mean(axis=2, keepdims=True)
    length = np.sqrt((rest**2).sum(axis=(1, 2, 3), keepdims=True))
    return rest / np.maximum(length, 1e-6)


def mirrored(cells: Float[np.ndarray, "*n 6 6 8"]) -> Float[np.ndarray, "*n 6 6 8"]:
    """The same of the pictures seen in a mirror."""
    return cells[..., ::-1, :][..., _MIRRORED]


def agreement(structure: Float32[np.ndarray, "n 6 6 8"]) -> float:
    """Mean cosine between two different pictures: 0 nothing in common, 1 all alike.

    Unbiased, so it may fall below 0 by chance.
    """
    rows = structure.reshape(len(structure), -1).astype(np.float64)
    total = rows.sum(axis=0)
    return float((total @ total - (rows**2).sum()) / (len(rows) * (len(rows) - 1)))


def symmetry(structure: Float32[np.ndarray, "n 6 6 8"]) -> float:
    """Agreement between pictures and other pictures' mirror images, over agreement: about -1..1, best 1.

    Unbiased above and below, so that few pictures look no less symmetric than many; it may pass 1 by chance.
    """
    total = structure.sum(axis=0, dtype=np.float64)
    own = float((structure * mirrored(structure)).sum(dtype=np.float64))
    across = (float((total * mirrored(total)).sum()) - own) / (len(structure) * (len(structure) - 1))
    return across / max(agreement(structure), 1e-3)


def frame_filled(structure: Float32[np.ndarray, "n 6 6 8"]) -> float:
    """Share of the frame that the mean structure covers, 0..1: (sum of energy)^2 / (cells x sum of squares).

    The energy that chance puts into a mean of so few pictures is taken off first.
    """
    mean = structure.mean(axis=0, dtype=np.float64)
    chance = ((structure**2).mean(axis=(0, 3)) - (mean**2).mean(axis=2)) / (len(structure) - 1)
    energy = np.clip((mean**2).mean(axis=2) - chance, 0, None)
    return float(energy.sum() ** 2 / max(CELLS**2 * float((energy**2).sum()), 1e-18))


def symmetry_axis(grey: Float32[np.ndarray, "n 32 32"], reach: int = 14) -> Axis:
    """Look for an axis in steps of half a pixel, at most ``reach`` of them to either side.

    An axis off the middle has to be better than the middle by 0.02.
    """
    right, down = np.gradient(grey, axis=2), np.gradient(grey, axis=1)
    mean = np.sqrt(np.hypot(right, down)).mean(axis=0, dtype=np.float64)
    mean -= mean.mean(axis=1, keepdims=True)
    width = mean.shape[1]
    found: dict[int, float] = {}
    for twice in range(-reach, reach + 1):  # twice the distance, in pixels of the small picture
        part = mean[:, max(0, twice) : min(width, width + twice)]
        part = part - part.mean(axis=1, keepdims=True)
        found[twice] = float((part * part[:, ::-1]).sum() / max(float((part**2).sum()), 1e-12))
    best = max(found, key=lambda twice: (found[twice] - _MARGIN * (twice != 0), -abs(twice)))
    return Axis(best / 2 / width, found[best])


def explained(
    grey: Float32[np.ndarray, "n 32 32"], generator: np.random.Generator, components: int = 8
) -> tuple[float, float]:
    """Share of unseen pictures' energy that the others' mean and few principal components explain, 0..1.

    Grey pictures, the mean of each row taken off, length 1; half of them fit, the other half is explained.
    The second number is that of the same pictures, each continued by its mirror image and rolled sideways by
    chance: what smoothness alone gives.
    """
    there_and_back = np.concatenate([grey, grey[:, :, ::-1]], axis=2)
    start = generator.integers(0, there_and_back.shape[2], len(grey))
    columns = (start[:, None] + np.arange(grey.shape[2])) % there_and_back.shape[2]
    rolled = np.take_along_axis(there_and_back, columns[:, None, :], axis=2)
    order = generator.permutation(len(grey))
    return _explained(grey[order], components), _explained(rolled[order], components)


def _explained(grey: np.ndarray, components: int) -> float:
    rest = (grey - grey.mean(axis=2, keepdims=True)).reshape(len(grey), -1)
    rest = rest / np.maximum(np.linalg.norm(rest, axis=1, keepdims=True), 1e-6)
    fit, unseen = rest[::2], rest[1::2]
    mean = fit.mean(axis=0)
    directions = np.linalg.svd(fit - mean, full_matrices=False)[2][:components]
    basis = np.linalg.qr(np.concatenate([mean[None], directions]).T)[0]
    return float(((unseen @ basis) ** 2).sum() / max(float((unseen**2).sum()), 1e-12))
