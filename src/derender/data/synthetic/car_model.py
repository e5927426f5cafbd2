"""A car's traits to one painted mesh: its body, and what is mounted on it.

Wheels, mirrors, light bars, wings, rails, an ambulance's box, a jeep's fittings: everything is a rounded box
or a wheel, placed by the body's measures, and comes in mirror images or lies across the middle.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from derender.data.synthetic.car_body import ARCH, BED_FROM, BED_TO, body_lines, body_pieces
from derender.data.synthetic.car_mesh import Grid, join, mirrored, moved, rounded_box, wheel, wheel_house
from derender.data.synthetic.car_paint import (
    BLACK,
    CHROME,
    WHITE,
    ambulance_box_paint,
    side_paint,
    top_paint,
    wheel_paint,
)
from derender.data.synthetic.car_traits import CarTraits
from derender.data.synthetic.decals import Colour, Decal, Paint, Surface, box, paint_table, ring
from derender.data.synthetic.mesh_image import TriangleMesh

Place = Callable[..., int]  # registers a surface (colour, part, decals) and returns its number
_BAR_BLUE: Colour = (0.05, 0.22, 0.95)
_BAR_RED: Colour = (0.95, 0.05, 0.06)
_TYRE: Colour = (0.055, 0.055, 0.06)


def build_car(car: CarTraits) -> tuple[TriangleMesh, Paint]:
    """TriangleMesh in metres (x right, y down, z to the rear; ground at y = 0) and its paint."""
    surfaces: list[Surface] = []

    def place(colour: Colour, part: str = "trim", decals: list[Decal] | None = None, **more: Any) -> int:
        surfaces.append(Surface(colour, part, tuple(decals or ()), **more))
        return len(surfaces) - 1

    s = car.shape
    top = place(car.paint, "body", top_paint(car), folded=True)
    holes = tuple((at, s.wheel, ARCH * s.wheel) for at in (s.front_wheel, s.rear_wheel) if car.name != "jeep")
    side = place(car.paint, "body", side_paint(car), holes=holes)
    pieces, flank = body_pieces(s, top, side)

    def half_width(z: float, y: float) -> float:
        """The body's half width about that place."""
        return float(flank[np.argmin((flank[:, 2] - z) ** 2 + (flank[:, 1] - y) ** 2), 0])

    pieces += _wheels(car, half_width, place)
    pieces += _mirrors(car, half_width, place)
    own = {"police": _light_bar, "ambulance": _ambulance_box, "sports": _wing, "jeep": _jeep}
    if car.name in own:
        pieces += own[car.name](car, place)
    if car.name in ("suv", "estate") and car.chances[9] < 0.7:
        pieces += _rails(car, place)
    return join(pieces), paint_table(surfaces)


def _both(grids: list[Grid]) -> list[Grid]:
    return [*grids, *(mirrored(grid) for grid in grids)]


def _wheels(car: CarTraits, side: Callable[[float, float], float], place: Place) -> list[Grid]:
    s = car.shape
    tyre, well = place(_TYRE, "wheel", wheel_paint(car)), place(BLACK)
    template = wheel((0, s.wheel, 0), s.wheel, 0.28 if car.name == "jeep" else 0.24, tyre)
    pieces = []
    for at in (s.front_wheel, s.rear_wheel):
        if car.name == "jeep":
            pieces.append(moved(template, (s.width / 2 + 0.15, 0, at)))
            continue
        out = min(side(at + k * s.wheel, s.wheel * h) for k in (-1.1, 0, 1.1) for h in (0.8, 1.2)) - 0.025
        pieces.append(moved(template, (out, 0, at)))
        pieces.append(wheel_house(out - 0.25, (at, s.wheel), ARCH * s.wheel + 0.01, s.sill, side, well))
    return _both(pieces)


def _mirrors(car: CarTraits, side: Callable[[float, float], float], place: Place) -> list[Grid]:
    s = car.shape
    ahead, tall = (0.1, 0.15) if car.style in ("van", "cab") else (0.28, 0.08)
    at = s.cowl_at + ahead
    centre = (side(at, s.cowl - 0.05) + 0.09, s.cowl + 0.10 + tall - 0.08, at)
    return _both(rounded_box(centre, (0.11, tall, 0.05), 0.04, place(car.trim if car.plastic else car.paint)))


def _light_bar(car: CarTraits, place: Place) -> list[Grid]:
    middle, half, top = car.shape.screen_at + 0.42, 0.58, car.shape.height + 0.10
    left = _BAR_RED if car.chances[8] < 0.6 else _BAR_BLUE
    lamps = [box(-half - 0.1, -9, -0.16, 9, left, "light"), box(0.16, -9, half + 0.1, 9, _BAR_BLUE, "light")]
    glass, foot = place((0.85, 0.86, 0.9), "light", lamps), place(BLACK)
    return [
        *rounded_box((0, top - 0.06, middle), (half, 0.05, 0.13), 0.03, foot),
        *rounded_box((0, top + 0.03, middle), (half + 0.04, 0.075, 0.16), 0.05, glass),
    ]


def _ambulance_box(car: CarTraits, place: Place) -> list[Grid]:
    s = car.shape
    low, high = s.sill + 0.32, s.height + 0.62
    front, rear = s.screen_at + 0.62, s.length
    half, tall, long = s.width / 2 + 0.1, 0.5 * (high - low), 0.5 * (rear - front)
    above, ahead, beside = ambulance_box_paint(car, low, high, front, rear)
    numbers = (
        place(WHITE, "body", above),
        place(WHITE, "body", ahead, folded=True),
        place(WHITE, "body"),
        place(WHITE, "body", beside),
    )
    lamp = place(_BAR_RED if car.livery != 2 and car.chances[8] < 0.5 else _BAR_BLUE, "light")
    return [
        *rounded_box((0, low + tall, 0.5 * (front + rear)), (half, tall, long), 0.07, numbers),
        *_both(rounded_box((half - 0.3, high - 0.02, front + 0.08), (0.24, 0.12, 0.14), 0.05, lamp)),
        *_both(rounded_box((half - 0.3, high - 0.02, rear - 0.12), (0.2, 0.09, 0.1), 0.04, lamp)),
        *rounded_box((0, s.height + 0.07, s.screen_at + 0.2), (0.55, 0.08, 0.13), 0.05, lamp),
    ]


def _wing(car: CarTraits, place: Place) -> list[Grid]:
    s = car.shape
    half, at = 0.86 * s.width / 2, s.tail_at - 0.1
    number = place(car.paint, "body") if car.chances[6] < 0.55 else place(BLACK)
    if car.chances[5] < 0.25:
        return rounded_box((0, s.tail + 0.05, s.tail_at - 0.04), (half, 0.04, 0.13), 0.035, number, 0.3)
    height = s.tail + 0.24 + 0.12 * car.chances[7]
    stand = (0.025, 0.5 * (height - s.tail) + 0.02, 0.09)
    return [
        *_both(rounded_box((0.6 * half, 0.5 * (s.tail + height), at), stand, 0.02, number)),
        *_both(rounded_box((half + 0.01, height + 0.03, at), (0.02, 0.1, 0.18), 0.015, number)),
        *rounded_box((0, height, at), (half, 0.03, 0.17), 0.025, number, 0.12),
    ]


def _rails(car: CarTraits, place: Place) -> list[Grid]:
    edge = body_lines(car.shape, np.array([4.1, 4.5, 4.9])).edge
    number = place(BLACK if car.chances[3] < 0.5 else CHROME)
    centre = (0.93 * edge[:, 0].min(), edge[:, 1].mean() + 0.05, edge[:, 2].mean())
    return _both(rounded_box(centre, (0.025, 0.03, 0.5 * (edge[-1, 2] - edge[0, 2])), 0.02, number))


def _jeep(car: CarTraits, place: Place) -> list[Grid]:
    s = car.shape
    black = place(car.trim)
    inner, outer = 0.55 * s.width / 2, s.width / 2 + 0.16
    pieces = []
    for at in (s.front_wheel, s.rear_wheel):
        centre, half = (0.5 * (inner + outer), 2 * s.wheel + 0.08, at), 0.5 * (outer - inner)
        pieces += _both(rounded_box(centre, (half, 0.05, 1.25 * s.wheel), 0.04, black))
    pieces += rounded_box((0, s.bumper - 0.04, -0.06), (0.95 * s.width / 2, 0.11, 0.12), 0.03, black)
    spare = place(_TYRE, "wheel", [*wheel_paint(car), ring(0, 0, (0.34, 0.34), BLACK)])
    if car.style == "jeep_hard" and car.chances[8] < 0.35:
        bonnet = wheel((0, s.wheel, 0), s.wheel * 0.92, 0.22, spare, backwards=True)
        pieces.append(_lying(bonnet, 0.55 * (s.nose_at + s.cowl_at), 0.5 * (s.nose + s.cowl) + 0.16))
    else:
        at = (0, s.cowl - 0.08, s.length + 0.24)
        pieces.append(wheel(at, s.wheel * 0.95, 0.24, spare, backwards=True))
    return pieces + (_open_cabin(car, place) if car.style == "jeep_open" else [])


def _lying(grid: Grid, at: float, height: float) -> Grid:
    """A wheel that looks to the rear, laid on its back at (0, height, at)."""
    x, y, z = np.moveaxis(grid.points - grid.points[0, 0], -1, 0)
    points = np.stack([x, z, -y], axis=-1) + np.array([0.0, height, at])
    x, y, z = np.moveaxis(grid.normals, -1, 0)
    return Grid(points, np.stack([x, -z, y], axis=-1), grid.chart, grid.surface)


def _open_cabin(car: CarTraits, place: Place) -> list[Grid]:
    s = car.shape
    half, x = 0.92 * s.width / 2, 0.78 * s.width / 2
    colour = car.paint if car.chances[6] < 0.5 else car.trim
    pane = box(-0.86 * half, s.cowl + 0.06, 0.86 * half, s.cowl + 0.46, car.glass, "window")
    f, g = place(colour), place(colour, "trim", [pane])
    start, end = body_lines(s, np.array([BED_FROM, BED_TO])).middle[:, 2]
    bar_at, top = start + 0.5 * (end - start), s.cowl + 0.56
    roll = place(BLACK)
    seat = place((0.36, 0.27, 0.18) if car.chances[4] < 0.5 else (0.13, 0.13, 0.14))
    post, stay = (0.045, 0.5 * (top - 0.6), 0.045), (x, 0.5 * (top + s.cowl), bar_at + 0.42)
    return [
        *rounded_box((0, s.cowl + 0.26, s.cowl_at + 0.14), (half, 0.28, 0.025), 0.02, (f, g, g, f), 0.22),
        *_both(rounded_box((x, 0.5 * (top + 0.6), bar_at), post, 0.04, roll)),
        *rounded_box((0, top, bar_at), (x + 0.045, 0.045, 0.045), 0.04, roll),
        *_both(rounded_box(stay, (0.04, 0.4, 0.04), 0.035, roll, -0.8)),
        *_both(rounded_box((0.34, 0.98, bar_at - 0.24), (0.22, 0.36, 0.07), 0.06, seat, 0.2)),
        *_both(rounded_box((0.34, 0.70, bar_at - 0.5), (0.23, 0.09, 0.24), 0.06, seat)),
        *rounded_box((0, 0.92, end - 0.42), (0.52, 0.3, 0.07), 0.06, seat, 0.2),
    ]
