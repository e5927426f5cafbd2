"""Paint as flat shapes on charts: each surface of a mesh has a colour, a part, and shapes that lie on it.

A chart is a pair of coordinates carried by the mesh; for cars (share of the half width, station) on top of
the body, (z, y) in metres beside it, metres on boxes, wheel radii on wheels. Shapes are looked up at every
sample of an image, so their edges are as sharp at 512 pixels as at 32. The last shape that holds a point
wins. Numba keeps compiled kernels by their own file alone: after a change here, touch ``mesh_image``.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, no_type_check

import numpy as np
from numpy import ndarray

from derender.render.numba_threads import kernel

SAMPLES = 3  # of a pixel, in each direction
_ALL = SAMPLES * SAMPLES
PARTS = ("background", "body", "window", "wheel", "light", "trim", "plate")
MOST_CORNERS = 9
_POLYGON, _BOX, _RING, _SPOKES, _CHECKER = range(5)
# columns of a shape: kind, multiplies, part, colour, bounds, then its own numbers
_KIND, _MULTIPLIES, _PART, _COLOUR, _BOUNDS, _SHAPE = 0, 1, 2, 3, 6, 10
_LENGTH = _SHAPE + 1 + 2 * MOST_CORNERS
Colour = tuple[float, float, float]
Point = tuple[float, float]
Bounds = tuple[float, float, float, float]
Decal = tuple[float, ...]  # the columns of one shape


@dataclass(frozen=True)
class Surface:
    """What is on one chart: colour and part where no shape lies, shapes (later ones on top).

    ``folded`` takes the first coordinate without its sign, so that paint is symmetric; ``holes`` are circles
    (u, v, radius) where there is no surface.
    """

    colour: Colour
    part: str
    decals: tuple[Decal, ...] = ()
    folded: bool = False
    holes: tuple[tuple[float, float, float], ...] = ()


class Paint(NamedTuple):
    """Surfaces as arrays: k has rows ``first[k]`` to ``first[k + 1]`` of ``decals``, and so of ``holes``."""

    colour: ndarray  # (surfaces, 3) float32
    part: ndarray  # (surfaces,) int32
    first: ndarray  # (surfaces + 1,) int32
    folded: ndarray  # (surfaces,) int32
    decals: ndarray  # (decals, numbers) float32
    first_hole: ndarray  # (surfaces + 1,) int32
    holes: ndarray  # (holes, 3) float32


def paint_table(surfaces: Sequence[Surface]) -> Paint:
    rows = [row for surface in surfaces for row in surface.decals]
    return Paint(
        colour=np.array([s.colour for s in surfaces], np.float32).reshape(-1, 3),
        part=np.array([PARTS.index(s.part) for s in surfaces], np.int32),
        first=np.cumsum([0, *(len(s.decals) for s in surfaces)]).astype(np.int32),
        folded=np.array([s.folded for s in surfaces], np.int32),
        decals=np.array(rows, np.float32).reshape(len(rows), _LENGTH),
        first_hole=np.cumsum([0, *(len(s.holes) for s in surfaces)]).astype(np.int32),
        holes=np.array([hole for s in surfaces for hole in s.holes], np.float32).reshape(-1, 3),
    )


def polygon(
    points: Sequence[Point] | ndarray, colour: Colour, part: str = "", multiplies: bool = False
) -> Decal:
    """A polygon of at most nine corners, in any direction. Without a part, that below stays."""
    corners = points.tolist() if isinstance(points, ndarray) else points
    assert 3 <= len(corners) <= MOST_CORNERS, len(corners)
    across, along = zip(*corners, strict=True)
    bounds = min(across), min(along), max(across), max(along)
    numbers = [value for point in corners for value in point]
    return _decal(_POLYGON, colour, part, bounds, len(corners), *numbers, multiplies=multiplies)


def box(u0: float, v0: float, u1: float, v1: float, colour: Colour, part: str = "") -> Decal:
    return _decal(_BOX, colour, part, (min(u0, u1), min(v0, v1), max(u0, u1), max(v0, v1)))


def line(u0: float, v0: float, u1: float, v1: float, width: Point, shade: float = 0.6) -> Decal:
    """A thin line, ``width`` across it per coordinate, that multiplies the colour below by ``shade``."""
    u, v = 0.5 * width[0], 0.5 * width[1]
    corners = [(u0 - u, v0 - v), (u1 - u, v1 - v), (u1 + u, v1 + v), (u0 + u, v0 + v)]
    return polygon(corners, (shade, shade, shade), multiplies=True)


def ring(u: float, v: float, radius: Point, colour: Colour, part: str = "", inner: float = 0.0) -> Decal:
    """An ellipse, hollow from ``inner`` (a share of the radius) inwards."""
    bounds = u - radius[0], v - radius[1], u + radius[0], v + radius[1]
    return _decal(_RING, colour, part, bounds, u, v, *radius, inner)


def spokes(count: int, open_share: float, inner: float, outer: float, colour: Colour) -> Decal:
    """The gaps between a wheel's spokes, about (0, 0), between two radii."""
    return _decal(_SPOKES, colour, "", (-outer, -outer, outer, outer), count, open_share, inner, outer)


def checker(bounds: Bounds, cell: Point, colour: Colour, odd: int = 0) -> Decal:
    """Every second field of a chequered rectangle."""
    return _decal(_CHECKER, colour, "", bounds, *cell, odd)


def _decal(
    kind: int, colour: Colour, part: str, bounds: Bounds, *shape: float, multiplies: bool = False
) -> Decal:
    number = PARTS.index(part) if part else -1
    numbers = (kind, float(multiplies), number, *colour, *bounds, *shape)
    return numbers + (0.0,) * (_LENGTH - len(numbers))


@kernel
@no_type_check
def paint_samples(decals, first, end, base, base_part, surface, spot, of, inside, colour, part):
    """Fill in colour and part of a pixel's samples on one surface: the last shape that holds a point wins."""
    low_p, high_p = np.float32(np.inf), -np.float32(np.inf)
    low_q, high_q = low_p, high_p
    for s in range(np.uint32(_ALL)):
        if of[s] == surface:
            low_p, high_p = min(low_p, spot[0, s]), max(high_p, spot[0, s])
            low_q, high_q = min(low_q, spot[1, s]), max(high_q, spot[1, s])
            for n in range(3):
                colour[s, n] = base[n]
            part[s] = base_part
    for d in range(np.uint32(first), np.uint32(end)):
        decal = decals[d]
        outside = high_p < decal[_BOUNDS] or high_q < decal[_BOUNDS + 1]
        if outside or low_p > decal[_BOUNDS + 2] or low_q > decal[_BOUNDS + 3]:
            continue
        _cover(decal, spot, inside)
        multiplies, named = decal[_MULTIPLIES] > np.float32(0.0), decal[_PART] >= np.float32(0.0)
        for s in range(np.uint32(_ALL)):
            if inside[s] and of[s] == surface:
                for n in range(3):
                    value = decal[_COLOUR + n]
                    colour[s, n] = colour[s, n] * value if multiplies else value
                if named:
                    part[s] = int(decal[_PART])


@kernel
@no_type_check
def _cover(decal, spot, inside):
    """Which of a pixel's samples a shape holds."""
    kind = decal[_KIND]
    if kind == _POLYGON:
        inside[:] = False
        corners = np.uint32(decal[_SHAPE])
        x0, y0 = decal[_SHAPE + 2 * corners - 1], decal[_SHAPE + 2 * corners]
        for k in range(corners):
            x, y = decal[_SHAPE + 1 + 2 * k], decal[_SHAPE + 2 + 2 * k]
            slope = (x0 - x) / (y0 - y) if y0 != y else np.float32(0.0)
            for s in range(np.uint32(_ALL)):
                q = spot[1, s]
                crosses = ((y > q) != (y0 > q)) & (spot[0, s] < slope * (q - y) + x)
                inside[s] = inside[s] ^ crosses
            x0, y0 = x, y
        return
    u0, v0, u1, v1 = decal[_BOUNDS], decal[_BOUNDS + 1], decal[_BOUNDS + 2], decal[_BOUNDS + 3]
    for s in range(np.uint32(_ALL)):
        p, q = spot[0, s], spot[1, s]
        inside[s] = p >= u0 and q >= v0 and p <= u1 and q <= v1
        if inside[s] and kind != _BOX:
            inside[s] = _covers(decal, kind, p, q)


@kernel
@no_type_check
def _covers(decal, kind, p, q):
    """Whether a ring, spokes or a chequered field hold a point within their bounds."""
    if kind == _RING:
        x, y = (p - decal[_SHAPE]) / decal[_SHAPE + 2], (q - decal[_SHAPE + 1]) / decal[_SHAPE + 3]
        away = x * x + y * y
        return away <= np.float32(1.0) and away >= decal[_SHAPE + 4] * decal[_SHAPE + 4]
    if kind == _CHECKER:
        column = int(np.floor((p - decal[_BOUNDS]) / decal[_SHAPE]))
        row = int(np.floor((q - decal[_BOUNDS + 1]) / decal[_SHAPE + 1]))
        return (column + row) % 2 == int(decal[_SHAPE + 2])
    away = np.sqrt(p * p + q * q)
    if away < decal[_SHAPE + 2] or away > decal[_SHAPE + 3]:
        return False
    turn = np.arctan2(q, p) / np.float32(2.0 * np.pi) * decal[_SHAPE]
    return turn - np.floor(turn) < decal[_SHAPE + 1]
