"""Paint as flat shapes on charts: each surface of a car has a colour, a part, and shapes that lie on it in
order.

A chart is a pair of coordinates carried by the mesh: (share of the half width, station) on top of the body,
(z, y) in metres beside it, metres on boxes, wheel radii on wheels. Shapes are looked up at every sample of a
picture, so their edges are as sharp at 512 pixels as at 32. The last shape that holds a point wins.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32
from numpy import ndarray

PARTS = ("background", "body", "window", "wheel", "light", "trim", "plate")
Colour = tuple[float, float, float]
Point = tuple[float, float]
Bounds = tuple[float, float, float, float]
Decal = tuple[float, ...]  # the numbers of one shape, as below
POLYGON, BOX, RING, SPOKES, CHECKER = range(5)
MOST_CORNERS = 9
# kind, multiplies, part, colour, bounds, then the shape's own numbers
KIND, MULTIPLIES, PART, COLOUR, BOUNDS, SHAPE = 0, 1, 2, 3, 6, 10
_LENGTH = SHAPE + 1 + 2 * MOST_CORNERS


@dataclass(frozen=True)
class Surface:
    """What is on one chart.

    Attributes:
        colour, part: where no shape lies.
        decals: shapes, later ones on top.
        folded: the first chart coordinate is taken without its sign, so that paint is symmetric.
        holes: circles (u, v, radius) where there is no surface.
    """

    colour: Colour
    part: str
    decals: tuple[Decal, ...] = ()
    folded: bool = False
    holes: tuple[tuple[float, float, float], ...] = ()


@dataclass(frozen=True)
class PaintTable:
    """Surfaces as arrays for the rasteriser.

    Surface k has the rows ``first[k]`` to ``first[k + 1]`` of ``decals``, and likewise of ``holes``.
    """

    colour: Float32[ndarray, "surfaces 3"]
    part: Int32[ndarray, "surfaces"]
    first: Int32[ndarray, "surfaces_and_end"]
    folded: Int32[ndarray, "surfaces"]
    decals: Float32[ndarray, "decals numbers"]
    first_hole: Int32[ndarray, "surfaces_and_end"]
    holes: Float32[ndarray, "holes 3"]


def paint_table(surfaces: Sequence[Surface]) -> PaintTable:
    rows = [row for surface in surfaces for row in surface.decals]
    return PaintTable(
        colour=np.array([s.colour for s in surfaces], np.float32),
        part=np.array([PARTS.index(s.part) for s in surfaces], np.int32),
        first=np.cumsum([0, *(len(s.decals) for s in surfaces)]).astype(np.int32),
        folded=np.array([s.folded for s in surfaces], np.int32),
        decals=np.array(rows, np.float32).reshape(len(rows), _LENGTH),
        first_hole=np.cumsum([0, *(len(s.holes) for s in surfaces)]).astype(np.int32),
        holes=np.array([hole for s in surfaces for hole in s.holes], np.float32).reshape(-1, 3),
    )


def polygon(points: Sequence[Point] | ndarray, colour: Colour, part: str = "") -> Decal:
    """A polygon of at most nine corners, in any direction. Without a part, that below stays."""
    corners = points.tolist() if isinstance(points, ndarray) else points
    assert 3 <= len(corners) <= MOST_CORNERS, len(corners)
    across, along = [point[0] for point in corners], [point[1] for point in corners]
    bounds = min(across), min(along), max(across), max(along)
    numbers = [value for point in corners for value in point]
    return _decal(POLYGON, colour, part, bounds, len(corners), *numbers)


def box(u0: float, v0: float, u1: float, v1: float, colour: Colour, part: str = "") -> Decal:
    return _decal(BOX, colour, part, (min(u0, u1), min(v0, v1), max(u0, u1), max(v0, v1)))


def line(u0: float, v0: float, u1: float, v1: float, width: Point, shade: float = 0.6) -> Decal:
    """A thin line that changes what lies below by the factor ``shade``; ``width`` is across it, per
    coordinate."""
    u, v = 0.5 * width[0], 0.5 * width[1]
    corners = [(u0 - u, v0 - v), (u1 - u, v1 - v), (u1 + u, v1 + v), (u0 + u, v0 + v)]
    whole = polygon(corners, (shade, shade, shade))
    return (*whole[:MULTIPLIES], 1.0, *whole[MULTIPLIES + 1 :])


def ring(u: float, v: float, radius: Point, colour: Colour, part: str = "", inner: float = 0.0) -> Decal:
    """An ellipse, hollow from ``inner`` (a share of the radius) inwards."""
    bounds = u - radius[0], v - radius[1], u + radius[0], v + radius[1]
    return _decal(RING, colour, part, bounds, u, v, *radius, inner)


def spokes(count: int, open_share: float, inner: float, outer: float, colour: Colour) -> Decal:
    """The gaps between a wheel's spokes, about (0, 0), between two radii."""
    return _decal(SPOKES, colour, "", (-outer, -outer, outer, outer), count, open_share, inner, outer)


def checker(bounds: Bounds, cell: Point, colour: Colour, odd: int = 0) -> Decal:
    """Every second field of a chequered rectangle."""
    return _decal(CHECKER, colour, "", bounds, *cell, odd)


def _decal(kind: int, colour: Colour, part: str, bounds: Bounds, *shape: float) -> Decal:
    number = PARTS.index(part) if part else -1
    numbers = (kind, 0.0, number, *colour, *bounds, *shape)
    return numbers + (0.0,) * (_LENGTH - len(numbers))
