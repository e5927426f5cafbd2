"""The paint of a car: windows, lamps, grille, plates, door lines, wheel arches; and what marks its class.

There are two charts. (share of the half width, station) is on top, where one row of shapes suits every body
style. (z, y) in metres is beside, where windows follow the body's lines. Police cars, ambulances and sports
cars carry usual colours and patterns: black and white, a blue band, blue and yellow fields, orange stripes
and a cross or a six-pointed star. None is that of an existing service. Leaves out interiors behind the glass
and lettering that can be read.
"""

from collections.abc import Sequence
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from numpy import ndarray

from derender.data.synthetic.car_body import (
    BED_FROM,
    BED_SIDE,
    BED_TO,
    PARTS,
    BodyLines,
    CarShape,
    Colour,
    Decal,
    body_lines,
)
from derender.data.synthetic.decals import BOX, DECAL_LENGTH, ELLIPSE, MOST_CORNERS

BLACK: Colour = (0.03, 0.03, 0.035)
CHROME: Colour = (0.72, 0.73, 0.75)
WHITE: Colour = (0.93, 0.93, 0.92)
_LAMP, _AMBER, _RED, _PLATE = (0.95, 0.95, 0.88), (0.95, 0.55, 0.08), (0.72, 0.04, 0.05), (0.93, 0.93, 0.90)
_BLUE, _YELLOW, _CROSS_RED = (0.06, 0.18, 0.70), (0.88, 0.90, 0.12), (0.82, 0.06, 0.07)
_AMBULANCE: tuple[Colour, ...] = ((0.92, 0.30, 0.06), _CROSS_RED, _YELLOW)  # stripes of each livery
_DOORS_M = {"van": 1.05, "cab": 1.0, "jeep_hard": 1.0, "jeep_open": 1.0}
_THREE_BOXES = ("sedan", "coupe", "sports")
_TWO_DOORS = ("coupe", "sports", "jeep_hard", "jeep_open", "pickup", "van", "cab")


class CarTraits(NamedTuple):
    """One model."""

    name: str  # its class
    style: str  # its body style
    shape: CarShape
    paint: Colour  # of the body
    roof: Colour
    glass: Colour  # of the windows
    rim: Colour  # of the wheels
    trim: Colour  # of plastic
    bumpers: Colour  # the body's or the trim's
    spokes: int  # of a wheel
    chances: list[float]  # ten uniform numbers that decide on fittings, each by its own position
    livery: int  # which of its class's liveries (police, ambulance, sports)

    @property
    def plastic(self) -> bool:
        """Whether the bumpers are of plastic rather than painted as the body."""
        return self.bumpers != self.paint


def _decal(
    kind: int, colour: Colour, part: str, bounds: Sequence[float], *own: float, multiplies: bool = False
) -> Decal:
    numbers = (kind, multiplies, PARTS.index(part) if part else -1, *colour, *bounds, *own)
    return numbers + (0.0,) * (DECAL_LENGTH - len(numbers))


def polygon(
    points: Sequence[Any] | ndarray, colour: Colour, part: str = "", multiplies: bool = False
) -> Decal:
    """A polygon of at most nine corners, in any direction. Without a part, that below stays."""
    corners = points.tolist() if isinstance(points, ndarray) else points
    assert 3 <= len(corners) <= MOST_CORNERS, len(corners)
    across, along = zip(*corners, strict=True)
    bounds = min(across), min(along), max(across), max(along)
    return _decal(len(corners), colour, part, bounds, *chain(*corners), multiplies=multiplies)


def box(u0: float, v0: float, u1: float, v1: float, colour: Colour, part: str = "") -> Decal:
    return _decal(BOX, colour, part, (min(u0, u1), min(v0, v1), max(u0, u1), max(v0, v1)))


def line(u0: float, v0: float, u1: float, v1: float, width: tuple[float, float], shade: float = 0.6) -> Decal:
    """A thin line, ``width`` across it per coordinate, that multiplies the colour below by ``shade``."""
    u, v = 0.5 * width[0], 0.5 * width[1]
    corners = [(u0 - u, v0 - v), (u1 - u, v1 - v), (u1 + u, v1 + v), (u0 + u, v0 + v)]
    return polygon(corners, (shade, shade, shade), multiplies=True)


def ellipse(u: float, v: float, radius: tuple[float, float], colour: Colour, part: str = "") -> Decal:
    bounds = u - radius[0], v - radius[1], u + radius[0], v + radius[1]
    return _decal(ELLIPSE, colour, part, bounds, 0.0, 0.0, 1.0)


def _checker(
    u0: float, v0: float, u1: float, v1: float, cell: tuple[float, float], colour: Colour, odd: int = 0
) -> list[Decal]:
    """Every second field of a chequered rectangle."""
    across, along = np.arange(u0, u1, cell[0]), np.arange(v0, v1, cell[1])
    return [
        box(u, v, min(u + cell[0], u1), min(v + cell[1], v1), colour)
        for i, u in enumerate(across.tolist())
        for j, v in enumerate(along.tolist())
        if (i + j) % 2 == odd
    ]


def _kept(*rows: tuple[bool, Decal]) -> list[Decal]:
    """The shapes of those rows whose condition holds."""
    return [decal for holds, decal in rows if holds]


def top_paint(car: CarTraits) -> list[Decal]:
    """Shapes on the front, bonnet, windscreen, roof, rear window, boot and rear."""
    rooflight = car.chances[0] < 0.25 and car.name in ("sedan", "hatchback", "estate", "suv", "limousine")
    three_boxes, closed = car.style in _THREE_BOXES, car.style != "jeep_open"
    low, lamp = 5.72, [(0.8, 7.0), (1.01, 6.85), (1.01, 7.85), (0.8, 7.7)]
    if three_boxes:
        low, lamp = 5.95, [(0.5, 7.12), (1.01, 6.98), (1.01, 7.5), (0.56, 7.5)]
    floor = (0.12, 0.12, 0.125) if closed else (0.16, 0.15, 0.14)
    return [
        *_top_livery(car),
        *_kept(
            (car.roof != car.paint, box(0, 3.95, 1.01, 5.2, car.roof, "body")),
            (rooflight, box(0, 4.22, 0.62, 4.55, car.glass, "window")),
        ),
        *(_jeep_front(car) if car.name == "jeep" else _front(car)),
        line(0.84, 2.12, 0.9, 2.97, (0.022, 0), 0.62),  # shut lines of bonnet and boot
        line(0, 2.1, 0.86, 2.14, (0, 0.05), 0.7),
        line(0.3, 2.2, 0.4, 2.95, (0.02, 0), 0.88),
        *_kept(
            (three_boxes, line(0.86, 6.1, 0.86, 6.97, (0.022, 0), 0.62)),
            (closed, polygon([(0, 2.97), (0.95, 3.02), (0.93, 3.95), (0, 3.97)], BLACK, "trim")),
            (closed, polygon([(0, 3.05), (0.91, 3.1), (0.88, 3.88), (0, 3.9)], car.glass, "window")),
            (
                closed and (car.style not in ("van", "cab") or car.chances[6] < 0.5),
                polygon([(0, 5.14), (0.86, 5.14), (0.9, low), (0, low)], car.glass, "window"),
            ),
            (True, polygon(lamp, _RED, "light")),
            (True, box(0, 7.35, 0.3, 7.65, _PLATE, "plate")),
            (car.plastic, box(0, 7.75, 1.01, 9.01, car.bumpers, "trim")),
            (not car.plastic, box(0, 8.3, 0.7, 9.01, BLACK, "trim")),
            (car.shape.bed > 0, box(0, BED_FROM + 0.005, BED_SIDE + 0.01, BED_TO + 0.005, floor, "trim")),
        ),
    ]


def _top_livery(car: CarTraits) -> list[Decal]:
    if car.name == "ambulance":
        stripe = _AMBULANCE[car.livery]
        return [box(0, 1.98, 1.01, 2.22, stripe), *_word(2.5, 0.5, 0.28, stripe)]
    if car.name == "sports" and car.chances[8] < 0.45:
        return [box(0.10, 1.7, 0.30, 9.0, WHITE if sum(car.paint) < 1.9 else BLACK)]
    if car.name != "police":
        return []
    if car.livery == 0:
        return [box(0, 3.9, 1.01, 5.25, WHITE), *_word(2.5, 0.5, 0.22, WHITE)]
    if car.livery == 1:
        bonnet = polygon([(0, 2.1), (1.01, 2.1), (1.01, 2.42), (0, 2.9)], _BLUE)
        return [bonnet, box(0, 6.15, 1.01, 6.95, _BLUE), *_word(2.42, 0.42, 0.18, WHITE)]
    return [
        box(0.62, 2.1, 1.01, 2.95, _YELLOW),
        *_checker(0.62, 2.1, 1.01, 2.95, (0.39, 0.215), _BLUE, 1),
        *_word(2.5, 0.46, 0.24, _BLUE),
        box(0.5, 6.15, 1.01, 6.95, _YELLOW),
    ]


def _front(car: CarTraits) -> list[Decal]:
    sports, chances = car.name == "sports", car.chances
    wide, grille = 0.78 if sports else 0.5 + 0.15 * chances[1], 0.36 + 0.16 * chances[2]
    inner, (low, high) = 0.52 + 0.1 * chances[5], (1.72, 2.1) if chances[4] < 0.4 else (1.5, 2.06)
    lamp = np.array([(inner, low + 0.12), (1.01, low), (1.01, high + 0.06), (inner + 0.03, high - 0.04)])
    if sports:
        low, high = 1.9, 2.4
        lamp = np.array([(0.62, 1.92), (0.97, 1.95), (1.01, 2.5), (0.9, 2.42), (0.66, 2.12)])
    middle = np.array([0.5 * (inner + 0.03 + 1.0), 0.5 * (low + high)])
    return _kept(
        (car.plastic, box(0, 0, 1.01, 1.3, car.bumpers, "trim")),
        (True, box(0, 0.25 if car.plastic else 0.45, wide, 0.95, BLACK, "trim")),
        (sports, box(0, 0, 1.01, 0.28, BLACK, "trim")),
        (sports, polygon([(0.5, 0.3), (0.9, 0.3), (0.86, 1.1), (0.56, 0.95)], BLACK, "trim")),
        (not sports, ellipse(0.78, 0.72, (0.08, 0.22), _LAMP, "light")),
        (not sports and chances[3] < 0.6, box(0, 1.36, grille + 0.04, 1.93, CHROME, "trim")),
        (not sports, box(0, 1.44, grille, 1.86, BLACK, "trim")),
        (not sports and chances[3] < 0.3, box(0, 1.62, grille, 1.68, CHROME, "trim")),
        (not sports, ellipse(0, 1.66, (0.05, 0.12), CHROME, "trim")),
        (True, polygon(lamp, (0.30, 0.31, 0.33), "light")),
        (True, polygon(middle + (0.86, 0.76) * (lamp - middle), _LAMP, "light")),
        (True, box(0, 1.02, 0.3, 1.3, _PLATE, "plate")),
    )


def _jeep_front(car: CarTraits) -> list[Decal]:
    half, tall, lamp = 0.82 * car.shape.width / 2, car.shape.nose - car.shape.bumper, 0.105
    return [
        box(0, 0, 1.01, 0.96, car.trim, "trim"),
        *(box(u - 0.035, 1.16, u + 0.035, 1.82, BLACK, "trim") for u in (0.0, 0.15, 0.30, 0.45)),
        ellipse(0.74, 1.5, (1.2 * lamp / half, 1.2 * lamp / tall), CHROME, "light"),
        ellipse(0.74, 1.5, (lamp / half, lamp / tall), _LAMP, "light"),
        ellipse(0.95, 1.2, (0.05, 0.08), _AMBER, "light"),
    ]


def side_paint(car: CarTraits) -> list[Decal]:
    """Shapes on both sides."""
    s, lines, edges = car.shape, body_lines(car.shape, np.linspace(0.0, 9.0, 181)), _door_edges(car)
    waist = [float(lines.waist[np.argmin(np.abs(lines.waist[:, 2] - at)), 1]) for at in edges]
    middle, handle = 0.55 * waist[0] + 0.45 * s.sill, CHROME if car.chances[3] < 0.3 else car.trim
    doors, top = list(zip(edges, waist, strict=True)), s.bumper + 0.3 * (s.nose - s.bumper)
    rows = (35, 41) if car.chances[4] < 0.4 else (31, 40)
    (_, ay, az), (_, by, bz) = lines.edge[list((40, 48) if car.name == "sports" else rows)].tolist()
    front = [(az - 0.1, ay), (az + 0.12, ay + 0.01), (bz + 0.26, by - 0.03), (bz - 0.1, by + 0.05)]
    (_, ay, az), (_, by, bz) = lines.edge[[150, 140]].tolist()
    rear = [(az + 0.1, ay), (az - 0.12, ay + 0.02), (bz - 0.22, by - 0.06), (bz + 0.1, by + 0.02)]
    arches = []
    for at in (s.front_wheel, s.rear_wheel):
        wide = ellipse(at, s.wheel, (1.36 * s.wheel, 1.36 * s.wheel), car.trim, "trim")
        arches.append((car.plastic and car.name != "jeep", wide))
        arches.append((True, ellipse(at, s.wheel, (1.17 * s.wheel, 1.17 * s.wheel), BLACK, "trim")))
    return [
        *_side_livery(car, edges),
        *_kept(
            (True, box(0, 0, s.length, s.sill + 0.05, car.trim, "trim")),
            (car.plastic, box(0, 0, s.length, s.sill + 0.12, car.trim, "trim")),
            (car.plastic, box(-0.1, 0, s.front_wheel - 0.2, top, car.bumpers, "trim")),
            (car.plastic, box(s.rear_wheel + 0.2, 0, s.length + 0.1, top, car.bumpers, "trim")),
        ),
        *(line(at, s.sill + 0.08, at, y, (0.03, 0), 0.5) for at, y in doors),
        *(box(at - 0.27, y - 0.12, at - 0.1, y - 0.08, handle, "trim") for at, y in doors[1:]),
        line(edges[0], middle, edges[-1] + 0.3, middle + 0.04, (0, 0.03), 0.8),
        *(_windows(car, lines, edges) if car.style != "jeep_open" else []),
        *_kept((car.name != "jeep", polygon(front, _LAMP, "light")), (True, polygon(rear, _RED, "light"))),
        *_kept(*arches),
    ]


def _side_livery(car: CarTraits, edges: list[float]) -> list[Decal]:
    s = car.shape
    low, high = s.sill + 0.16, s.cowl - 0.12
    if car.name == "ambulance":
        return [box(0, low + 0.1, s.length, low + 0.4, _AMBULANCE[car.livery])]
    if car.name == "limousine":
        return [line(0.3, high, s.length - 0.3, high, (0, 0.045), 2.0 if sum(car.paint) < 1.0 else 0.6)]
    if car.name != "police":
        return []
    if car.livery < 2:
        white, blue = (edges[0], 0, edges[-1], 3.0, WHITE), (0.2, low + 0.12, s.length - 0.2, high, _BLUE)
        return [box(*(blue if car.livery else white))]
    band, field = (0.1, low, s.length - 0.1, high), 0.5 * (high - low)
    return [box(*band, _YELLOW), *_checker(*band, (2.2 * field, field), _BLUE)]


def wheel_paint(car: CarTraits) -> list[Decal]:
    """Rim, the gaps between its spokes, and hub, about (0, 0) in wheel radii."""
    gaps = _decal(ELLIPSE, (0.10, 0.10, 0.105), "", (-0.62, -0.62, 0.62, 0.62), 0.24 / 0.62, car.spokes, 0.45)
    hub = (0.6 * car.rim[0], 0.6 * car.rim[1], 0.6 * car.rim[2])
    return [ellipse(0, 0, (0.72, 0.72), car.rim), gaps, ellipse(0, 0, (0.13, 0.13), hub)]


def ambulance_paint(car: CarTraits, low: float, high: float, front: float, rear: float) -> list[list[Decal]]:
    """An ambulance's box from above, from the front, and from the side: stripe, fields or band, sign,
    window."""
    middle, stripe = 0.5 * (front + rear), _AMBULANCE[car.livery]
    band = (front, low + 0.25, rear, low + 0.62)
    fields = _checker(*band, (0.45, 0.185), (0.10, 0.48, 0.20)) if car.livery == 2 else []
    side = [
        box(*band, stripe),
        *fields,
        *_sign(car, middle + 0.35, low + 1.12, 0.24, 0.24),
        box(front + 0.25, low + 1.0, front + 0.95, low + 1.4, car.glass, "window"),
        box(front, high - 0.2, rear, high - 0.12, stripe),
    ]
    return [_sign(car, 0.0, middle, 0.62, 0.72), [box(0.0, high - 0.34, 0.7, high - 0.16, stripe)], side]


def _door_edges(car: CarTraits) -> list[float]:
    """Where doors begin and end along the car."""
    s = car.shape
    first = max(s.front_wheel + 1.2 * s.wheel, s.cowl_at + 0.05)
    share = 0.9 if car.style != "pickup" else 1.0
    last = s.cowl_at + share * (min(s.deck_at, s.rear_wheel + 0.35) - s.cowl_at)
    if car.style in _TWO_DOORS:
        return [first, min(first + _DOORS_M.get(car.style, 1.3), last)]
    if car.name == "limousine":
        return [first, first + 0.95, last - 1.0, last]
    return [first, 0.5 * (first + last) + 0.02, last]


def _windows(car: CarTraits, lines: BodyLines, edges: list[float]) -> list[Decal]:
    waist, edge = (side[:, 2:0:-1] for side in (lines.waist, lines.edge))
    corners = np.concatenate([
        waist[[70, 84, 100, 110]] + (0.0, 0.035), edge[[105, 98, 88, 79, 72]] - (0.0, 0.05),
    ])  # fmt: skip
    corners[[4, 7, 8]] += [(-0.06, 0.0), (0.05, 0.0), (0.09, 0.03)]
    outline = corners + 0.035 * np.sign(corners - corners.mean(axis=0))
    decals = [
        polygon(outline, CHROME if car.name == "limousine" else BLACK, "trim"),
        polygon(corners, car.glass, "window"),
    ]
    if car.style == "van" and car.chances[6] < 0.6:  # a panel instead of windows
        right, top = outline.max(axis=0).tolist()
        return [*decals, box(edges[-1], float(outline[0, 1]), right, top, car.paint, "body")]
    post, part = (BLACK, "trim") if car.chances[7] < 0.5 else (car.paint, "body")
    for at in edges[1:]:
        if corners[0, 0] + 0.2 < at < corners[3, 0] - 0.1:  # as high as the window is there
            ends = np.roll(corners, -1, axis=0)
            a, b = (each[(corners[:, 0] > at) != (ends[:, 0] > at)] for each in (corners, ends))
            v = a[:, 1] + (b[:, 1] - a[:, 1]) * (at - a[:, 0]) / (b[:, 0] - a[:, 0])
            decals.append(box(at - 0.045, float(v.min()), at + 0.045, float(v.max()), post, part))
    return decals


def _sign(car: CarTraits, u: float, v: float, half_u: float, half_v: float) -> list[Decal]:
    """A red cross, or a blue star of six arms."""
    if car.livery != 0:
        arms = ((0.32 * half_u, half_v), (half_u, 0.32 * half_v))
        return [box(u - across, v - along, u + across, v + along, _CROSS_RED) for across, along in arms]
    decals = []
    for turn in np.pi * np.array([0.0, 1.0, 2.0]) / 3.0:
        along = np.array([half_u * np.sin(turn), half_v * np.cos(turn)])
        across = 0.17 * np.array([half_u * np.cos(turn), -half_v * np.sin(turn)])
        arm = np.array([along + across, along - across, -along - across, across - along])
        decals.append(polygon(arm + np.array([u, v]), _BLUE))
    return decals


def _word(v: float, half: float, tall: float, colour: Colour) -> list[Decal]:
    """Bars in the middle that look like a word from afar."""
    pitch = half / 3.0
    return [box(pitch * (k + 0.14), v - tall / 2, pitch * (k + 0.86), v + tall / 2, colour) for k in range(3)]
