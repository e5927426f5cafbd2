"""The geometry of a car: measures, the body as one smooth grid, boxes and wheels, and one mesh of all.

Stations run along the body's outline seen from the side. In front: 0 lower lip, 1 bumper, 2 nose, 3 cowl, 4
upper edge of the windscreen. Behind: 5 end of the roof, 6 lower edge of the window, 7 upper edge of the tail,
8 bumper, 9 lower lip. Across, the surface goes from the middle over the crowned top to the edge, and down the
glass to the waist. The waist is the windows' lower edge, or the shoulder of bonnet and boot. Then it goes
down the side to the sill. The half with x > 0 is mirrored, so the body is exactly symmetric. Wheel arches are
holes of the paint.

Points are metres, x right, y UP from the ground, z from the front to the rear; ``join`` turns y down. A
grid's columns and rows are ordered so that d/dcolumn x d/drow points inwards. Leaves out undersides.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from derender.data.synthetic.decals import DECAL_LENGTH, Paint
from derender.data.synthetic.mesh_image import TriangleMesh, grid_triangles, unit
from derender.data.synthetic.settings import numbers_of

PARTS = ("background", "body", "window", "wheel", "light", "trim", "plate")
ARCH = 1.13  # radius of the wheel arches in wheel radii
BED_FROM, BED_TO, BED_SIDE = 6.12, 6.93, 0.86
Colour = tuple[float, float, float]
Points = Float[ndarray, "points 3"]
Decal = tuple[float, ...]  # the columns of one shape, as in mesh_image
Places = Mapping[str, float]  # lengths by name, as ``cars.yaml`` uses them
_LAST = 9  # station
_ROWS_BETWEEN = (4, 6, 9, 10, 8, 10, 9, 6, 4)  # rows from each station to the next
_ACROSS = np.array([0.0, 0.22, 0.44, 0.62, 0.76, BED_SIDE, BED_SIDE + 0.02, 0.93, 0.97, 1.0])
_GLASS = np.array([0.15, 0.38, 0.62, 0.85, 1.0])
_SIDE = np.array([0.05, 0.13, 0.26, 0.4, 0.55, 0.7, 0.85, 1.0])
_ROUND = np.array([0.42, 0.32, 0.16, 0.26, 0.26, 0.16, 0.28, 0.42])  # stations, most of each inner corner
_DOWN, _FLIP = np.array([1.0, -1.0, 1.0]), np.array([-1.0, 1.0, 1.0])
_TURN = np.linspace(0.0, 2.0 * np.pi, 25)
_RIM = np.array([-1.0, -0.5, 0.5, 1.0])  # of a box's face: 1 is its rounded rim, 0.5 its flat inside


class CarShape(NamedTuple):
    """One body, in metres. ``*_at`` lies along the car from its front; heights are from the ground."""

    length: float  # of the body without mirrors and what is mounted on it, as width and height
    width: float
    height: float
    sill: float  # height of the body's lower edge
    front_wheel: float  # where the axles are
    rear_wheel: float
    wheel: float  # radius of the wheels
    nose_at: float  # upper edge of the front face
    nose: float
    cowl_at: float  # where bonnet and windscreen meet
    cowl: float
    screen_at: float  # upper edge of the windscreen
    roof_end_at: float  # rear end of the roof, and how much lower it is than the height
    roof_drop: float
    deck_at: float  # lower edge of the rear window
    deck: float
    tail_at: float  # upper edge of the rear face
    tail: float
    bumper: float  # height of the foremost point
    tumblehome: float  # how much narrower the roof is on each side than the body at the windows' lower edge
    hood_inset: float  # how much narrower the bonnet's front is on each side than the body
    bow: float  # how far the front's corners stand back
    flare: float  # how far the wings stand out around the wheels
    soft: float  # 0..1, how far the profile's corners are rounded
    bed: float  # depth of an open bed or cabin behind the deck line; 0 is none


@dataclass(frozen=True, eq=False)
class Surface:
    """One chart: colour and part where no shape lies, shapes (later ones on top), holes as in Paint."""

    colour: Colour
    part: str = "trim"
    decals: Sequence[Decal] = ()
    holes: Sequence[tuple[float, float, float]] = ((0.0, 0.0, 0.0),) * 2


class Grid(NamedTuple):
    """A piece: points (R,C,3) in metres, inward unit normals (R,C,3) in the y-down frame, chart (R,C,2)."""

    points: ndarray
    normals: ndarray
    chart: ndarray
    surface: Surface


def both(grids: Sequence[Grid]) -> list[Grid]:
    """The pieces, and those on the other side of x = 0."""
    mirrored = [
        Grid(g.points[:, ::-1] * _FLIP, g.normals[:, ::-1] * _FLIP, g.chart[:, ::-1], g.surface)
        for g in grids
    ]
    return [*grids, *mirrored]


def join(pieces: Sequence[Grid]) -> TriangleMesh:
    """One mesh of all pieces, y down from the ground at 0, with the paint of their surfaces."""
    starts = np.cumsum([0, *(g.points[..., 0].size for g in pieces[:-1])])
    cells = [grid_triangles(*g.points.shape[:2], (g.points.shape[1] - 1) / 2) for g in pieces]
    surfaces = list(dict.fromkeys(g.surface for g in pieces))
    owner = np.array([surfaces.index(g.surface) for g in pieces], np.int32)
    vertices, normals, chart = (
        np.concatenate([each.reshape(-1, each.shape[-1]) for each in arrays])
        for arrays in zip(*(g[:3] for g in pieces), strict=True)
    )
    return TriangleMesh(
        vertices=(vertices * _DOWN).astype(np.float32),
        triangles=np.concatenate([c + s for c, s in zip(cells, starts, strict=True)]).astype(np.int32),
        values=chart.astype(np.float32),
        number=np.repeat(owner, [len(c) for c in cells]),
        normals=normals.astype(np.float32),
        paint=Paint(
            colour=np.array([s.colour for s in surfaces], np.float32),
            part=np.array([PARTS.index(s.part) for s in surfaces], np.int32),
            holes=np.array([s.holes for s in surfaces], np.float32),
            first=np.cumsum([0, *(len(s.decals) for s in surfaces)]).astype(np.int32),
            decals=np.array([d for s in surfaces for d in s.decals], np.float32).reshape(-1, DECAL_LENGTH),
        ),
    )


def smooth_grid(points: Float[ndarray, "r c 3"], chart: Float[ndarray, "r c 2"], surface: Surface) -> Grid:
    """A grid whose normals are area-weighted means of the cells around each vertex."""
    p = points * _DOWN
    cells = np.cross(p[1:, 1:] - p[:-1, :-1], p[1:, :-1] - p[:-1, 1:])
    around = np.pad(cells, ((1, 1), (1, 1), (0, 0)))
    rows = around[1:] + around[:-1]
    return Grid(points, unit(rows[:, 1:] + rows[:, :-1]), chart, surface)


def rounded_box(
    centre: Sequence[float], half: Sequence[float], radius: float, surfaces: Sequence[Surface],
    lean_rad: float,
) -> list[Grid]:  # fmt: skip
    """A box with rounded edges and no underside; ``lean_rad`` tips its top to the rear.

    ``surfaces`` are those of top (chart x, z), front and rear (x, y) and sides (z, y).
    """
    row, column = np.meshgrid(-_RIM, _RIM, indexing="ij")  # rows run down or forwards, columns to the right
    one, edge = np.ones_like(row), min(radius, *half)
    sides = [(column, one, row), (column, row, -one), (-column, row, one), (one, row, column)]
    rim = np.moveaxis(np.array([*sides, (-one, row, -column)]), 1, -1)  # with the sign of the side
    flat, outward = np.sign(rim) * (np.asarray(half, float) - edge), unit(np.trunc(rim))
    cos, sin = np.cos(lean_rad), np.sin(lean_rad)
    turn = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
    points = (flat + edge * outward) @ turn.T + np.asarray(centre, float)
    normals = -(outward @ turn.T) * _DOWN
    top, front, rear, side = surfaces
    faces = ((top, [0, 2]), (front, [0, 1]), (rear, [0, 1]), (side, [2, 1]), (side, [2, 1]))
    return [Grid(points[i], normals[i], points[i][..., axes], s) for i, (s, axes) in enumerate(faces)]


def wheel(
    centre: Sequence[float], radius: float, width: float, surface: Surface, backwards: bool = False
) -> Grid:
    """A wheel whose outer face looks to the right (+x), or to the rear; ``centre`` is that face's middle. Its
    chart is in wheel radii."""
    out, r = np.transpose(numbers_of("cars")["wheel_rings"])[..., None]
    up, side = radius * r * np.cos(_TURN), -radius * r * np.sin(_TURN)
    axle = np.broadcast_to(out * width, up.shape)
    share = np.where(np.arange(len(r))[:, None] < 8, r, 1.2)
    chart = np.stack([share * np.cos(_TURN), share * np.sin(_TURN)], axis=-1)
    local = (-side, up, axle) if backwards else (axle, up, side)
    grid = smooth_grid(np.stack(local, axis=-1) + np.asarray(centre, float), chart, surface)
    grid.normals[:, 0] = grid.normals[:, -1] = unit(grid.normals[:, 0] + grid.normals[:, -1])
    return grid


def wheel_house(inside: float, at: float, shape: CarShape, flank: Points, surface: Surface) -> Grid:
    """The hollow of the wheel arch at z = ``at`` on the right: a disc at x = ``inside`` and the wall out to
    the body's side; nothing reaches below the sill."""
    radius = ARCH * shape.wheel + 0.01
    z, y = at - radius * np.sin(_TURN), shape.wheel + radius * np.cos(_TURN)
    out = np.where(y > shape.sill, half_width(flank, z, y) - 0.01, inside)
    y = np.maximum(y, shape.sill)
    rows = [(inside, shape.wheel, at), (inside, y, z), (inside, y, z), (out, y, z)]
    points = np.stack([np.stack(np.broadcast_arrays(*row, _TURN)[:3], axis=-1) for row in rows])
    return smooth_grid(points, points[..., [2, 1]], surface)


def half_width(flank: Points, z: Any, y: Any) -> Any:
    """The body's half width about those places, from the points of its right side."""
    away = (flank[:, 2] - np.asarray(z)[..., None]) ** 2 + (flank[:, 1] - np.asarray(y)[..., None]) ** 2
    return flank[np.argmin(away, axis=-1), 0]


@cache
def _terms(text: str) -> list[tuple[float, str]]:
    """Number and place of each term of a length: those of "0.5 width - 0.1" are 0.5 width and -0.1."""
    terms = re.findall(r"([+-]?) ?([\d.]*) ?([a-z_]*)", text)
    return [(float(f"{sign}{number or 1}"), place) for sign, number, place in terms if number or place]


def metres(length: str | float, places: Places) -> float:
    """A length of ``cars.yaml``; lengths on charts have the chart's units."""
    if not isinstance(length, str):
        return length
    return sum(number * places[place] if place else number for number, place in _terms(length))


class BodyLines(NamedTuple):
    """The lines that paint follows, each (stations, 3): middle, upper edge, waist and sill."""

    middle: Float[ndarray, "t 3"]
    edge: Float[ndarray, "t 3"]
    waist: Float[ndarray, "t 3"]
    sill: Float[ndarray, "t 3"]


def body_lines(shape: CarShape, stations: Float[ndarray, "t"]) -> BodyLines:
    """The body's lines at these stations (0..9): linear interpolation of rows whose corners are parabolas,
    lifted above the wheels of low cars, so that an arch fits below."""
    table, corners = _table(shape), _ROUND * (0.12 + 0.88 * shape.soft)
    low, from_ends = np.minimum(stations.astype(int), _LAST - 1), np.minimum(stations, _LAST - stations)
    slope = np.diff(table, axis=0)
    inside = np.maximum(0.0, corners - np.abs(stations[:, None] - np.arange(1, _LAST)))
    rows = table[low] + slope[low] * (stations - low)[:, None]
    rows += inside**2 / (4.0 * corners) @ np.diff(slope, axis=0)
    shoulder = np.clip((from_ends - 1.3) / 0.6, 0.0, 1.0) * (1.0 - _cabin(stations))
    for wheel_at in (shape.front_wheel, shape.rear_wheel):
        lack = (1.0 + ARCH) * shape.wheel + 0.07 - rows[:, 7]
        near = np.exp(-(((rows[:, 8] - wheel_at) / 0.45) ** 2))
        rows[:, [4, 7]] += (np.maximum(0.0, lack) * near * shoulder)[:, None]
    return BodyLines(*(rows[:, i : i + 3] for i in (0, 3, 6, 9)))


def body_pieces(shape: CarShape, top: Surface, side: Surface) -> tuple[list[Grid], Points]:
    """The body, and the points of its right side. Top's chart is (share of the half width to either side,
    station), side's (z, y)."""
    between = [i + np.arange(n) / n for i, n in enumerate(_ROWS_BETWEEN)]
    bed = [BED_FROM, BED_FROM + 0.01, BED_TO, BED_TO + 0.01]
    stations = np.sort(np.concatenate([*between, [float(_LAST)], bed]))
    half = _half(shape, stations)
    points = np.concatenate([half[:, :0:-1] * _FLIP, half], axis=1)[::-1]
    beside, across = points[..., [2, 1]], np.concatenate([_ACROSS[:0:-1], _ACROSS])
    above = np.stack(np.broadcast_arrays(across, stations[::-1, None]), axis=-1)
    whole, middle, edge = smooth_grid(points, beside, side), half.shape[1] - 1, len(_ACROSS) - 1
    upper, lower = slice(middle - edge, middle + edge + 1), slice(middle + edge, None)
    # with the whole's normals, so that neighbours join without a crease
    deck = Grid(points[:, upper], whole.normals[:, upper], above, top)
    right = Grid(points[:, lower], whole.normals[:, lower], beside[:, lower], side)
    return [both([right])[1], deck, right], points[:, middle + edge + 1 :].reshape(-1, 3)


def _table(s: CarShape) -> Float[ndarray, "stations 12"]:
    """Middle (x = 0), upper edge, waist and sill at each station, as ``cars.yaml`` lists them."""
    glass, top, belt = 0.035, 0.035 + s.tumblehome, s.cowl + 0.02
    back_belt = max(belt, s.deck - 0.04)
    if s.bed > 0 and s.screen_at - s.cowl_at < 0.2:  # an open top
        glass, top, belt, back_belt = 0.01, 0.06, s.cowl - 0.06, s.deck - 0.06
    places = {**s._asdict(), "glass": glass, "top": top, "belt": belt, "back_belt": back_belt}
    lines = numbers_of("cars")["lines"].values()
    table = [[metres(length, places) for length in (*x, *y, *z)] for x, y, z in lines]
    return np.reshape(table, (len(lines), 3, -1)).transpose(2, 0, 1).reshape(_LAST + 1, -1)


def _half(s: CarShape, stations: ndarray) -> Float[ndarray, "t c 3"]:
    """The half with x >= 0, from the middle to the sill."""
    a, cabin, lines = _ACROSS[:, None], _cabin(stations), body_lines(s, stations)
    across = np.concatenate([a, 0.4 * a**2 + 0.6 * a**8, 0.25 * a**2 + 0.75 * a**4], axis=1)
    top = lines.middle[:, None] + across * (lines.edge - lines.middle)[:, None]
    if s.bed > 0:
        inside = (stations > BED_FROM) & (stations < BED_TO + 0.005)
        top[inside, : np.searchsorted(_ACROSS, BED_SIDE) + 1, 1] -= s.bed
    edge, waist, f = lines.edge, lines.waist, _GLASS[:, None]
    corner = np.stack([waist[:, 0], edge[:, 1], 0.5 * (edge[:, 2] + waist[:, 2])], axis=-1)
    bulge = (0.9 - 0.75 * cabin)[:, None]  # 0 is straight, 1 leaves the edge level and drops at the end
    control = (0.5 * (edge + waist) * (1.0 - bulge) + corner * bulge)[:, None]
    glass = (1 - f) ** 2 * edge[:, None] + 2 * f * (1 - f) * control + f**2 * waist[:, None]
    down = waist[:, None] + _SIDE[:, None] * (lines.sill - waist)[:, None]
    down[..., 0] += 0.035 * (1.0 - np.exp(-_SIDE / 0.06)) * cabin[:, None]
    from_ends = np.clip(np.minimum(stations, _LAST - stations) - 0.4, 0.0, 1.0)[:, None]
    down[..., 0] += 0.05 * np.sin(np.pi * _SIDE) * (1.0 - _SIDE) * from_ends
    for wheel_at in (s.front_wheel, s.rear_wheel):
        away = np.hypot(down[..., 2] - wheel_at, down[..., 1] - s.wheel)
        stands_out = np.exp(-(((away - 1.2 * s.wheel) / 0.16) ** 2)) + 0.6 * np.exp(-((away / 0.7) ** 2))
        down[..., 0] += s.flare * stands_out * from_ends * np.clip((down[..., 1] - s.sill) / 0.25, 0.0, 1.0)
    return np.concatenate([top, glass, down], axis=1)


def _cabin(stations: ndarray) -> ndarray:
    """1 where the waist carries windows, 0 along bonnet and boot."""
    return np.clip(np.minimum(stations - 3.0, 6.0 - stations) / 0.5, 0.0, 1.0)
