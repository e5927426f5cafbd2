"""Everything that is measured on a set of pictures, joined.

Brightness, colour and copies are measured on every picture. What is learned from comparing pictures is
measured on distinct ones, at most ``COMPARED`` of them, evenly spaced; each such number comes with its error.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int64, UInt8

from derender.data.doctor.estimate import GROUPS, Estimate, jackknife
from derender.data.doctor.kinds import Halves, likeness, split_in_two
from derender.data.doctor.limits import LIMITS
from derender.data.doctor.near_copies import near_copy_groups
from derender.data.doctor.pixels import Pixels, measure_pixels, shrunk
from derender.data.doctor.structure import (
    Axis,
    agreement,
    edge_cells,
    explained,
    frame_filled,
    structure_of,
    symmetry,
    symmetry_axis,
)
from derender.data.doctor.variety import light_variety, side_light, view_variety

COMPARED = 4_000
"""Most pictures that are compared with one another."""

FEWEST_COMPARED = 2 * GROUPS
"""With fewer distinct pictures nothing can be said about what they share."""


@dataclass(frozen=True)
class Shared:
    """What distinct pictures share, and in what they vary (structure.py, kinds.py, variety.py).

    Attributes:
        rows: which pictures were compared.
        agreement, symmetry, view, light, fill: each with its error.
        axis: where the mean picture of edges is symmetric.
        explained, explained_rolled: see ``structure.explained``.
        odd: share of pictures unlike all others, with its error.
        likeness: of each compared picture with the others.
        halves: the two most different groups, or None.
        structure: what all this was measured on.
        sides: side light of each compared picture (variety.py).
    """

    rows: Int64[np.ndarray, " k"]
    agreement: Estimate
    symmetry: Estimate
    view: Estimate
    light: Estimate
    fill: Estimate
    axis: Axis
    explained: float
    explained_rolled: float
    odd: Estimate
    likeness: Float[np.ndarray, " k"]
    halves: Halves | None
    structure: Float32[np.ndarray, "k 6 6 8"]
    sides: Float[np.ndarray, "k 2"]


@dataclass(frozen=True)
class Measures:
    """Counts and shares over all pictures, and what the distinct ones share.

    Attributes:
        pictures: readable pictures, copies included.
        group: the first picture of each picture's group of copies and near copies.
        identical: copies to the last pixel, the first of each not counted.
        distinct: groups.
        pixels: one row for each picture.
        shared: None where fewer than ``FEWEST_COMPARED`` distinct pictures show anything.
    """

    pictures: int
    group: Int64[np.ndarray, " n"]
    identical: int
    distinct: int
    pixels: Pixels
    shared: Shared | None

    @property
    def near_copies(self) -> int:
        """Pictures that differ a little from an earlier one."""
        return self.pictures - self.distinct - self.identical

    @property
    def clipped(self) -> float:
        """Mean share of pixels that are black or white."""
        return float((self.pixels.dark + self.pixels.bright).mean())


def measure(
    images: UInt8[np.ndarray, "n 3 s s"],
    identical: int,
    generator: np.random.Generator,
    progress: Callable[[int, int], object] | None = None,
) -> Measures:
    """Measure a set of pictures, of which ``identical`` are copies of earlier ones to the last pixel."""
    pixels = measure_pixels(images, progress)
    group = near_copy_groups(pixels.tiny)
    distinct = np.unique(group)
    telling = distinct[~pixels.blank[distinct]]
    chosen = (
        telling[np.unique(np.linspace(0, len(telling) - 1, COMPARED).astype(int))]
        if len(telling)
        else telling
    )
    shared = _shared(images, chosen, generator) if len(chosen) >= FEWEST_COMPARED else None
    return Measures(len(images), group, identical, len(distinct), pixels, shared)


def _shared(images: np.ndarray, rows: np.ndarray, generator: np.random.Generator) -> Shared:
    grey = np.concatenate([shrunk(images[part]) for part in np.array_split(rows, -(-len(rows) // 256))])
    structure = structure_of(edge_cells(grey))
    sides = side_light(grey)
    alike = likeness(structure)
    odd = float((alike < LIMITS.odd_likeness).mean())
    by_parts, by_parts_rolled = explained(grey, generator)
    count = len(rows)
    return Shared(
        rows=rows,
        agreement=jackknife(lambda kept: agreement(structure[kept]), count),
        symmetry=jackknife(lambda kept: symmetry(structure[kept]), count),
        view=jackknife(lambda kept: view_variety(structure[kept]), count),
        light=jackknife(lambda kept: light_variety(sides[kept]), count),
        fill=jackknife(lambda kept: frame_filled(structure[kept]), count),
        axis=symmetry_axis(grey),
        explained=by_parts,
        explained_rolled=by_parts_rolled,
        odd=Estimate(odd, float(np.sqrt(odd * (1 - odd) / count))),
        likeness=alike,
        halves=split_in_two(structure, generator),
        structure=structure,
        sides=sides,
    )
