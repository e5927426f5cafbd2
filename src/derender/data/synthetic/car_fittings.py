"""What is mounted on a body: wheels, mirrors, light bars, wings, rails, an ambulance's box, a jeep's
fittings.

Everything is a rounded box or a wheel, placed by the body's measures, and comes in mirror images or lies
across the middle. A fitting names its surface by a key; ``SURFACES`` says how keys look.
"""

from collections.abc import Callable

import numpy as np

from derender.data.synthetic.car_body import ARCH, BED_FROM, BED_TO, body_lines
from derender.data.synthetic.car_decals import Colour, Surface, box, ring
from derender.data.synthetic.car_livery import box_front_livery, box_side_livery, box_top_livery
from derender.data.synthetic.car_mesh import Grid, mirrored, moved, rounded_box, wheel, wheel_house
from derender.data.synthetic.car_paint import BLACK, CHROME, wheel_decals
from derender.data.synthetic.car_traits import CarTraits

Place = Callable[[Surface], int]  # registers a surface and returns its number
BAR_BLUE: Colour = (0.05, 0.22, 0.95)
BAR_RED: Colour = (0.95, 0.05, 0.06)
_TYRE: Colour = (0.055, 0.055, 0.06)


def fittings(car: CarTraits, side: Callable[[float, float], float], place: Place) -> list[Grid]:
    """Every fitting of the car; ``side(z, y)`` is the body's half width there."""
    pieces = _wheels(car, side, place)
    pieces += _mirrors(car, side, place)
    for name, add in (
        ("police", _light_bar),
        ("ambulance", _ambulance_box),
        ("sports", _wing),
        ("jeep", _jeep),
    ):
        if car.name == name:
            pieces += add(car, place)
    if car.name in ("suv", "estate") and car.chances[9] < 0.7:
        pieces += _rails(car, place)
    return pieces


def _both(grids: list[Grid]) -> list[Grid]:
    return [*grids, *(mirrored(grid) for grid in grids)]


def _wheels(car: CarTraits, side: Callable[[float, float], float], place: Place) -> list[Grid]:
    s = car.shape
    tyre = place(Surface(_TYRE, "wheel", tuple(wheel_decals(car))))
    well = place(Surface(BLACK, "trim"))
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
    at = s.cowl_at + (0.28 if car.style not in ("van", "cab") else 0.1)
    height = s.cowl + 0.10
    tall = 0.15 if car.style in ("van", "cab") else 0.08
    colour = car.trim if car.bumpers != car.paint else car.paint
    out = side(at, s.cowl - 0.05) + 0.09
    return _both(
        rounded_box((out, height + tall - 0.08, at), (0.11, tall, 0.05), 0.04, place(Surface(colour, "trim")))
    )


def _light_bar(car: CarTraits, place: Place) -> list[Grid]:
    s = car.shape
    middle = s.screen_at + 0.42
    half = 0.58
    red_too = car.chances[8] < 0.6
    lamps = [
        box(-half - 0.1, -9, -0.16, 9, BAR_RED if red_too else BAR_BLUE, "light"),
        box(0.16, -9, half + 0.1, 9, BAR_BLUE, "light"),
    ]
    glass = Surface((0.85, 0.86, 0.9), "light", tuple(lamps))
    number = place(glass)
    foot = place(Surface(BLACK, "trim"))
    top = s.height + 0.10
    return [
        *rounded_box((0, top - 0.06, middle), (half, 0.05, 0.13), 0.03, foot),
        *rounded_box((0, top + 0.03, middle), (half + 0.04, 0.075, 0.16), 0.05, number),
    ]


def _ambulance_box(car: CarTraits, place: Place) -> list[Grid]:
    s = car.shape
    low, high = s.sill + 0.32, s.height + 0.62
    front, rear = s.screen_at + 0.62, s.length
    half = s.width / 2 + 0.1
    middle, tall, long = 0.5 * (front + rear), 0.5 * (high - low), 0.5 * (rear - front)
    white: Colour = (0.93, 0.93, 0.92)
    numbers = (
        place(Surface(white, "body", tuple(box_top_livery(car, front, rear)), folded=False)),
        place(Surface(white, "body", tuple(box_front_livery(car, low, high)), folded=True)),
        place(Surface(white, "body")),
        place(Surface(white, "body", tuple(box_side_livery(car, low, high, front, rear)))),
    )
    lamp_colour = BAR_RED if car.livery != 2 and car.chances[8] < 0.5 else BAR_BLUE
    lamp = place(Surface(lamp_colour, "light"))
    pieces = rounded_box((0, low + tall, middle), (half, tall, long), 0.07, numbers)
    corner = _both(rounded_box((half - 0.3, high - 0.02, front + 0.08), (0.24, 0.12, 0.14), 0.05, lamp))
    back = _both(rounded_box((half - 0.3, high - 0.02, rear - 0.12), (0.2, 0.09, 0.1), 0.04, lamp))
    bar = rounded_box((0, s.height + 0.07, s.screen_at + 0.2), (0.55, 0.08, 0.13), 0.05, lamp)
    return [*pieces, *corner, *back, *bar]


def _wing(car: CarTraits, place: Place) -> list[Grid]:
    s = car.shape
    half = 0.86 * s.width / 2
    colour = car.paint if car.chances[6] < 0.55 else BLACK
    number = place(Surface(colour, "body" if colour == car.paint else "trim"))
    if car.chances[5] < 0.25:
        return rounded_box((0, s.tail + 0.05, s.tail_at - 0.04), (half, 0.04, 0.13), 0.035, number, 0.3)
    height = s.tail + 0.24 + 0.12 * car.chances[7]
    at = s.tail_at - 0.1
    stands = _both(
        rounded_box(
            (0.6 * half, 0.5 * (s.tail + height), at),
            (0.025, 0.5 * (height - s.tail) + 0.02, 0.09),
            0.02,
            number,
        )
    )
    ends = _both(rounded_box((half + 0.01, height + 0.03, at), (0.02, 0.1, 0.18), 0.015, number))
    return [*stands, *ends, *rounded_box((0, height, at), (half, 0.03, 0.17), 0.025, number, 0.12)]


def _rails(car: CarTraits, place: Place) -> list[Grid]:
    s = car.shape
    lines = body_lines(s, np.array([4.1, 4.5, 4.9]))
    number = place(Surface(BLACK if car.chances[3] < 0.5 else CHROME, "trim"))
    x, y = 0.93 * lines.edge[:, 0].min(), lines.edge[:, 1].mean() + 0.05
    long = 0.5 * (lines.edge[-1, 2] - lines.edge[0, 2])
    return _both(rounded_box((x, y, lines.edge[:, 2].mean()), (0.025, 0.03, long), 0.02, number))


def _jeep(car: CarTraits, place: Place) -> list[Grid]:
    s = car.shape
    black = place(Surface(car.trim, "trim"))
    outer = s.width / 2 + 0.16
    pieces = []
    inner = 0.55 * s.width / 2
    for at in (s.front_wheel, s.rear_wheel):
        place_of, half = (0.5 * (inner + outer), 2 * s.wheel + 0.08, at), 0.5 * (outer - inner)
        pieces += _both(rounded_box(place_of, (half, 0.05, 1.25 * s.wheel), 0.04, black))
    pieces += rounded_box((0, s.bumper - 0.04, -0.06), (0.95 * s.width / 2, 0.11, 0.12), 0.03, black)
    spare = Surface(_TYRE, "wheel", (*wheel_decals(car), ring(0, 0, (0.34, 0.34), BLACK)))
    if car.style == "jeep_hard" and car.chances[8] < 0.35:
        bonnet = wheel((0, s.wheel, 0), s.wheel * 0.92, 0.22, place(spare), backwards=True)
        turned = _lying(bonnet, 0.55 * (s.nose_at + s.cowl_at), 0.5 * (s.nose + s.cowl) + 0.16)
        pieces.append(turned)
    else:
        pieces.append(
            wheel((0, s.cowl - 0.08, s.length + 0.24), s.wheel * 0.95, 0.24, place(spare), backwards=True)
        )
    if car.style == "jeep_open":
        pieces += _open_cabin(car, place)
    return pieces


def _lying(grid: Grid, at: float, height: float) -> Grid:
    """A wheel that looks to the rear, laid on its back at (0, height, at)."""
    middle = grid.points[0, 0]
    p = grid.points - middle
    points = np.stack([p[..., 0], p[..., 2], -p[..., 1]], axis=-1) + np.array([0.0, height, at])
    n = grid.normals
    normals = np.stack([n[..., 0], -n[..., 2], n[..., 1]], axis=-1)
    return Grid(points, normals, grid.chart, grid.surface)


def _open_cabin(car: CarTraits, place: Place) -> list[Grid]:
    s = car.shape
    half = 0.92 * s.width / 2
    frame = Surface(car.paint if car.chances[6] < 0.5 else car.trim, "trim")
    pane = Surface(
        frame.colour,
        "trim",
        (box(-0.86 * half, s.cowl + 0.06, 0.86 * half, s.cowl + 0.46, car.glass, "window"),),
    )
    f, g = place(frame), place(pane)
    pieces = rounded_box((0, s.cowl + 0.26, s.cowl_at + 0.14), (half, 0.28, 0.025), 0.02, (f, g, g, f), 0.22)
    lines = body_lines(s, np.array([BED_FROM, BED_TO]))
    start, end = lines.middle[:, 2]
    roll = place(Surface(BLACK, "trim"))
    bar_at, top = start + 0.5 * (end - start), s.cowl + 0.56
    x = 0.78 * s.width / 2
    pieces += _both(
        rounded_box((x, 0.5 * (top + 0.6), bar_at), (0.045, 0.5 * (top - 0.6), 0.045), 0.04, roll)
    )
    pieces += rounded_box((0, top, bar_at), (x + 0.045, 0.045, 0.045), 0.04, roll)
    pieces += _both(
        rounded_box((x, 0.5 * (top + s.cowl), bar_at + 0.42), (0.04, 0.4, 0.04), 0.035, roll, -0.8)
    )
    cloth: Colour = (0.36, 0.27, 0.18) if car.chances[4] < 0.5 else (0.13, 0.13, 0.14)
    seat = place(Surface(cloth, "trim"))
    pieces += _both(rounded_box((0.34, 0.98, bar_at - 0.24), (0.22, 0.36, 0.07), 0.06, seat, 0.2))
    pieces += _both(rounded_box((0.34, 0.70, bar_at - 0.5), (0.23, 0.09, 0.24), 0.06, seat))
    pieces += rounded_box((0, 0.92, end - 0.42), (0.52, 0.3, 0.07), 0.06, seat, 0.2)
    return pieces
