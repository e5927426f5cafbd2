"""The body of a car as one smooth grid: ten stations along the outline, rounded, times a cross-section.

Stations run along the outline seen from the side: 0 lower lip of the front, 1 bumper, 2 nose, 3 cowl, 4
upper edge of the windscreen, 5 rear end of the roof, 6 lower edge of the rear window, 7 upper edge of the
tail, 8 rear bumper, 9 lower lip of the rear. At each station a row of numbers says where the middle of the
car, its upper edge, its waist (the windows' lower edge, or the shoulder of bonnet and boot) and its sill
are; between stations the rows are interpolated linearly with rounded corners. Across, the surface goes from
the middle over the crowned top to the edge, down the glass to the waist, and down the side to the sill. The
half with x > 0 is mirrored, so the body is exactly symmetric. Points are x to the right, y UP from the
ground, z to the rear. Wheel arches are holes of the paint. Leaves out the underside."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from derender.data.synthetic.car_mesh import Grid, part_of, smooth_grid
from derender.data.synthetic.car_traits import CarShape

STATIONS = 10
ARCH = 1.13  # radius of the wheel arches in wheel radii
BED_FROM, BED_TO, BED_SIDE = 6.12, 6.93, 0.86
_ROWS_BETWEEN = (4, 6, 9, 10, 8, 10, 9, 6, 4)  # rows from each station to the next
_ACROSS = np.array([0.0, 0.22, 0.44, 0.62, 0.76, BED_SIDE, BED_SIDE + 0.02, 0.93, 0.97, 1.0])
_GLASS = np.array([0.15, 0.38, 0.62, 0.85, 1.0])
_SIDE = np.array([0.05, 0.13, 0.26, 0.4, 0.55, 0.7, 0.85, 1.0])
_TOP, _EDGE = len(_ACROSS), len(_ACROSS) + len(_GLASS)


@dataclass(frozen=True)
class BodyLines:
    """The lines that paint follows, each (stations, 3): middle, upper edge, waist and sill."""

    stations: Float[ndarray, "t"]
    middle: Float[ndarray, "t 3"]
    edge: Float[ndarray, "t 3"]
    waist: Float[ndarray, "t 3"]
    sill: Float[ndarray, "t 3"]


def body_lines(shape: CarShape, stations: Float[ndarray, "t"]) -> BodyLines:
    """The body's lines at these stations (0..9)."""
    rows = _rounded(_table(shape), _corners(shape), stations)
    _raise_wings(shape, rows, stations)
    return BodyLines(stations, *(rows[:, i : i + 3] for i in (0, 3, 6, 9)))


def body_pieces(shape: CarShape, top: int, side: int) -> tuple[list[Grid], Float[ndarray, "points 3"]]:
    """The body with the numbers of its surfaces, and the points of its right side.

    The top's chart is (share of the half width, station), the sides' (z, y)."""
    stations = _stations()
    half = _half(shape, body_lines(shape, stations))
    left = half[:, :0:-1] * np.array([-1.0, 1.0, 1.0])
    points = np.concatenate([left, half], axis=1)[::-1]
    across = np.concatenate([_ACROSS, np.ones(len(_GLASS) + len(_SIDE))])
    share = np.concatenate([-across[:0:-1], across])
    chart_top = np.stack(np.broadcast_arrays(share[None], stations[::-1, None]), axis=-1)
    chart_side = points[..., [2, 1]]
    whole = smooth_grid(points, chart_top, top)
    middle = half.shape[1] - 1
    first, last = middle - _TOP + 1, middle + _TOP
    pieces = [
        part_of(whole, slice(0, first + 1), chart_side, side),
        part_of(whole, slice(first, last), chart_top, top),
        part_of(whole, slice(last - 1, None), chart_side, side),
    ]
    return pieces, points[:, last:].reshape(-1, 3)


@lru_cache(maxsize=1)
def _stations() -> ndarray:
    parts = [i + np.arange(n) / n for i, n in enumerate(_ROWS_BETWEEN)]
    bed = [BED_FROM, BED_FROM + 0.01, BED_TO, BED_TO + 0.01]
    return np.sort(np.concatenate([*parts, [float(STATIONS - 1)], bed]))


def _table(s: CarShape) -> Float[ndarray, "stations 12"]:
    """Middle (x = 0), upper edge, waist and sill at each station."""
    w, end = s.width / 2, s.length
    belt, back_belt = s.cowl + 0.02, max(s.cowl + 0.02, s.deck - 0.04)
    glass, top = w - 0.035, w - 0.035 - s.tumblehome
    cabin = s.deck_at - s.cowl_at
    bonnet = w - 0.07
    middle = np.array([
        (0, s.sill, 0.12), (0, s.bumper, 0.0), (0, s.nose, s.nose_at), (0, s.cowl, s.cowl_at),
        (0, s.height, s.screen_at), (0, s.height - s.roof_drop, s.roof_end_at), (0, s.deck, s.deck_at),
        (0, s.tail, s.tail_at), (0, s.bumper + 0.05, end), (0, s.sill + 0.04, end - 0.1),
    ])  # fmt: skip
    if s.bed > 0 and s.screen_at - s.cowl_at < 0.2:  # an open top
        glass, top, belt, back_belt = w - 0.01, w - 0.06, s.cowl - 0.06, s.deck - 0.06
    half = np.array([
        0.86 * w, 0.90 * w - 0.6 * s.hood_inset, 0.90 * w - s.hood_inset, bonnet - 0.02, top, top - 0.02,
        bonnet, 0.91 * w, 0.92 * w, 0.88 * w,
    ])  # fmt: skip
    bow = np.array([0.7, 1.0, 0.9, 0.35, 0.25, -0.12, -0.25, -0.5, -0.55, -0.5]) * s.bow
    edge = middle.copy()
    edge[:, 0], edge[:, 2] = half, middle[:, 2] + bow
    edge[2:8, 1] -= np.array([0.03, 0.045, 0.05, 0.05, 0.03, 0.02])
    waist = edge + np.array([
        (0.04 * w, 0.01, 0.05), (0.06 * w, -0.01, 0.05), (0.06 * w, -0.07, 0.06), (0.05, -0.06, 0.03),
        (0, 0, 0), (0, 0, 0), (0.05, -0.05, 0.0), (0.04 * w, -0.06, -0.04), (0.04 * w, -0.01, -0.05),
        (0.05 * w, 0.01, -0.04),
    ])  # fmt: skip
    waist[4] = glass, belt, s.cowl_at + 0.42 * cabin
    waist[5] = glass, back_belt, s.cowl_at + 0.78 * cabin
    below = waist.copy()
    below[:, 0] = 0.95 * w
    below[[0, 1, -2, -1], 0] = 0.91 * w, 0.94 * w, 0.94 * w, 0.91 * w
    below[:, 1] = s.sill
    below[[0, -1], 1] = waist[[0, -1], 1]
    below[1:3, 2] += [0.10, 0.16]
    below[7:9, 2] -= [0.16, 0.10]
    return np.concatenate([middle, edge, waist, below], axis=1)


def _corners(s: CarShape) -> Float[ndarray, "inner"]:
    """How far (in stations) each inner corner is rounded on both sides."""
    return np.array([0.42, 0.32, 0.16, 0.26, 0.26, 0.16, 0.28, 0.42]) * (0.12 + 0.88 * s.soft)


def _rounded(table: ndarray, corners: ndarray, t: ndarray) -> ndarray:
    """Linear interpolation of rows whose corners are parabolas: C1, exact outside the corners' reach."""
    low = np.minimum(t.astype(int), STATIONS - 2)
    slope = np.diff(table, axis=0)
    inside = np.maximum(0.0, corners - np.abs(t[:, None] - np.arange(1, STATIONS - 1)))
    return table[low] + slope[low] * (t - low)[:, None] + inside**2 / (4.0 * corners) @ np.diff(slope, axis=0)


def _half(s: CarShape, lines: BodyLines) -> Float[ndarray, "t c 3"]:
    """The half with x >= 0, from the middle to the sill."""
    a, cabin = _ACROSS[:, None], _cabin(lines.stations)
    across = np.concatenate([a, 0.4 * a**2 + 0.6 * a**8, 0.25 * a**2 + 0.75 * a**4], axis=1)
    top = lines.middle[:, None] + across * (lines.edge - lines.middle)[:, None]
    if s.bed > 0:
        inside = (lines.stations > BED_FROM) & (lines.stations < BED_TO + 0.005)
        top[inside, : np.searchsorted(_ACROSS, BED_SIDE) + 1, 1] -= s.bed
    glass = _bulged(lines.edge, lines.waist, _GLASS, 0.9 - 0.75 * cabin)
    down = lines.waist[:, None] + _SIDE[:, None] * (lines.sill - lines.waist)[:, None]
    down[..., 0] += 0.035 * (1.0 - np.exp(-_SIDE / 0.06)) * cabin[:, None]
    from_ends = np.clip(_from_ends(lines.stations) - 0.4, 0.0, 1.0)[:, None]
    down[..., 0] += 0.05 * np.sin(np.pi * _SIDE) * (1.0 - _SIDE) * from_ends
    half = np.concatenate([top, glass, down], axis=1)
    side = half[:, _EDGE:]
    for wheel in (s.front_wheel, s.rear_wheel):
        away = np.hypot(side[..., 2] - wheel, side[..., 1] - s.wheel)
        stands_out = np.exp(-(((away - 1.2 * s.wheel) / 0.16) ** 2)) + 0.6 * np.exp(-((away / 0.7) ** 2))
        side[..., 0] += s.flare * stands_out * from_ends * np.clip((side[..., 1] - s.sill) / 0.25, 0.0, 1.0)
    return half


def _raise_wings(shape: CarShape, rows: Float[ndarray, "t 12"], stations: Float[ndarray, "t"]) -> None:
    """Lift upper edge and waist above the wheels of low cars, so that an arch fits below."""
    shoulder = np.clip((_from_ends(stations) - 1.3) / 0.6, 0.0, 1.0) * (1.0 - _cabin(stations))
    for wheel in (shape.front_wheel, shape.rear_wheel):
        waist = rows[:, 6:9]
        lack = (1.0 + ARCH) * shape.wheel + 0.07 - waist[:, 1]
        near = np.exp(-(((waist[:, 2] - wheel) / 0.45) ** 2))
        rows[:, [4, 7]] += (np.maximum(0.0, lack) * near * shoulder)[:, None]


def _bulged(edge: ndarray, waist: ndarray, share: ndarray, bulge: ndarray) -> ndarray:
    """A parabola from edge to waist; ``bulge`` 0 is straight, 1 leaves the edge level and drops at the
    end."""
    corner = np.stack([waist[:, 0], edge[:, 1], 0.5 * (edge[:, 2] + waist[:, 2])], axis=-1)
    control = 0.5 * (edge + waist) * (1.0 - bulge[:, None]) + corner * bulge[:, None]
    f = share[:, None]
    return (1 - f) ** 2 * edge[:, None] + 2 * f * (1 - f) * control[:, None] + f**2 * waist[:, None]


def _from_ends(stations: ndarray) -> ndarray:
    """Stations from the nearer end of the outline."""
    return np.minimum(stations, STATIONS - 1 - stations)


def _cabin(stations: ndarray) -> ndarray:
    """1 where the waist carries windows, 0 along bonnet and boot."""
    return np.clip(np.minimum(stations - 3.0, 6.0 - stations) / 0.5, 0.0, 1.0)
