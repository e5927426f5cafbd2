"""The paint of a car: windows, lamps, grille, plates, door lines, wheel arches; and what marks its class.

Two charts: (share of the half width, station) on top, where one row of shapes suits every body style, and
(z, y) in metres beside, where windows follow the body's lines. Police cars, ambulances and sports cars carry
colours and patterns of the usual kinds (black and white, a blue band, blue and yellow fields, orange stripes
and a cross or a six-pointed star); none is that of an existing service. Leaves out interiors behind the glass
and lettering that can be read.
"""

import numpy as np
from numpy import ndarray

from derender.data.synthetic.car_body import BED_FROM, BED_SIDE, BED_TO, BodyLines, body_lines
from derender.data.synthetic.car_traits import CarTraits
from derender.data.synthetic.decals import Colour, Decal, box, checker, line, polygon, ring, spokes

BLACK: Colour = (0.03, 0.03, 0.035)
CHROME: Colour = (0.72, 0.73, 0.75)
WHITE: Colour = (0.93, 0.93, 0.92)
_LAMP: Colour = (0.95, 0.95, 0.88)
_AMBER: Colour = (0.95, 0.55, 0.08)
_RED: Colour = (0.72, 0.04, 0.05)
_PLATE: Colour = (0.93, 0.93, 0.90)
_BLUE: Colour = (0.06, 0.18, 0.70)
_YELLOW: Colour = (0.88, 0.90, 0.12)
_CROSS_RED: Colour = (0.82, 0.06, 0.07)
_AMBULANCE: tuple[Colour, ...] = ((0.92, 0.30, 0.06), _CROSS_RED, _YELLOW)  # stripes of each livery
_DOORS_M = {"van": 1.05, "cab": 1.0, "jeep_hard": 1.0, "jeep_open": 1.0}
_THREE_BOXES = ("sedan", "coupe", "sports")
_TWO_DOORS = ("coupe", "sports", "jeep_hard", "jeep_open", "pickup", "van", "cab")


def _kept(*rows: tuple[bool, Decal]) -> list[Decal]:
    """The shapes of those rows whose condition holds."""
    return [decal for holds, decal in rows if holds]


def top_paint(car: CarTraits) -> list[Decal]:
    """Shapes on the front, bonnet, windscreen, roof, rear window, boot and rear."""
    rooflight = car.chances[0] < 0.25 and car.name in ("sedan", "hatchback", "estate", "suv", "limousine")
    floor = (0.16, 0.15, 0.14) if car.style == "jeep_open" else (0.12, 0.12, 0.125)
    bed = box(0, BED_FROM + 0.005, BED_SIDE + 0.01, BED_TO + 0.005, floor, "trim")
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
        *_kept((car.style in _THREE_BOXES, line(0.86, 6.1, 0.86, 6.97, (0.022, 0), 0.62))),
        *_glass(car),
        *_rear(car),
        *_kept((car.shape.bed > 0, bed)),
    ]


def side_paint(car: CarTraits) -> list[Decal]:
    """Shapes on both sides."""
    s = car.shape
    lines = body_lines(s, np.linspace(0.0, 9.0, 181))
    decals = [*_side_livery(car), *_cladding(car), *_doors(car, lines), *_windows(car, lines)]
    decals += _side_lamps(car, lines)
    for at in (s.front_wheel, s.rear_wheel):
        wide, narrow = 1.36 * s.wheel, 1.17 * s.wheel
        decals += _kept(
            (car.plastic and car.name != "jeep", ring(at, s.wheel, (wide, wide), car.trim, "trim")),
            (True, ring(at, s.wheel, (narrow, narrow), BLACK, "trim")),
        )
    return decals


def wheel_paint(car: CarTraits) -> list[Decal]:
    rim = car.rim
    return [
        ring(0, 0, (0.72, 0.72), rim),
        spokes(car.spokes, 0.45, 0.24, 0.62, (0.10, 0.10, 0.105)),
        ring(0, 0, (0.13, 0.13), (0.6 * rim[0], 0.6 * rim[1], 0.6 * rim[2])),
    ]


def _front(car: CarTraits) -> list[Decal]:
    sports = car.name == "sports"
    wide, grille = 0.78 if sports else 0.5 + 0.15 * car.chances[1], 0.36 + 0.16 * car.chances[2]
    intake = [(0.5, 0.3), (0.9, 0.3), (0.86, 1.1), (0.56, 0.95)]
    return [
        *_kept(
            (car.plastic, box(0, 0, 1.01, 1.3, car.bumpers, "trim")),
            (True, box(0, 0.25 + (0.0 if car.plastic else 0.2), wide, 0.95, BLACK, "trim")),
            (sports, box(0, 0, 1.01, 0.28, BLACK, "trim")),
            (sports, polygon(intake, BLACK, "trim")),
            (not sports, ring(0.78, 0.72, (0.08, 0.22), _LAMP, "light")),
            (not sports and car.chances[3] < 0.6, box(0, 1.36, grille + 0.04, 1.93, CHROME, "trim")),
            (not sports, box(0, 1.44, grille, 1.86, BLACK, "trim")),
            (not sports and car.chances[3] < 0.3, box(0, 1.62, grille, 1.68, CHROME, "trim")),
            (not sports, ring(0, 1.66, (0.05, 0.12), CHROME, "trim")),
        ),
        *_head_lamps(car),
        box(0, 1.02, 0.3, 1.3, _PLATE, "plate"),
    ]


def _head_lamps(car: CarTraits) -> list[Decal]:
    inner = 0.52 + 0.1 * car.chances[5]
    low, high = (1.72, 2.1) if car.chances[4] < 0.4 else (1.5, 2.06)
    shape = [(inner, low + 0.12), (1.01, low), (1.01, high + 0.06), (inner + 0.03, high - 0.04)]
    if car.name == "sports":
        low, high = 1.9, 2.4
        shape = [(0.62, 1.92), (0.97, 1.95), (1.01, 2.5), (0.9, 2.42), (0.66, 2.12)]
    u0, t0 = 0.5 * (inner + 0.03 + 1.0), 0.5 * (low + high)
    glass = [(u0 + 0.86 * (u - u0), t0 + 0.76 * (t - t0)) for u, t in shape]
    return [polygon(shape, (0.30, 0.31, 0.33), "light"), polygon(glass, _LAMP, "light")]


def _jeep_front(car: CarTraits) -> list[Decal]:
    tall = car.shape.nose - car.shape.bumper
    half, lamp = car.shape.width / 2 * 0.82, 0.105
    return [
        box(0, 0, 1.01, 0.96, car.trim, "trim"),
        *(box(u - 0.035, 1.16, u + 0.035, 1.82, BLACK, "trim") for u in (0.0, 0.15, 0.30, 0.45)),
        ring(0.74, 1.5, (1.2 * lamp / half, 1.2 * lamp / tall), CHROME, "light"),
        ring(0.74, 1.5, (lamp / half, lamp / tall), _LAMP, "light"),
        ring(0.95, 1.2, (0.05, 0.08), _AMBER, "light"),
    ]


def _glass(car: CarTraits) -> list[Decal]:
    low = 5.95 if car.style in _THREE_BOXES else 5.72
    screen = [(0, 3.05), (0.91, 3.1), (0.88, 3.88), (0, 3.9)]
    frame = [(0, 2.97), (0.95, 3.02), (0.93, 3.95), (0, 3.97)]
    rear = [(0, 5.14), (0.86, 5.14), (0.9, low), (0, low)]
    closed = car.style != "jeep_open"
    see_through = car.style not in ("van", "cab") or car.chances[6] < 0.5
    return _kept(
        (closed, polygon(frame, BLACK if car.paint != BLACK else car.trim, "trim")),
        (closed, polygon(screen, car.glass, "window")),
        (closed and see_through, polygon(rear, car.glass, "window")),
    )


def _rear(car: CarTraits) -> list[Decal]:
    lamp = [(0.8, 7.0), (1.01, 6.85), (1.01, 7.85), (0.8, 7.7)]
    if car.style in _THREE_BOXES:
        lamp = [(0.5, 7.12), (1.01, 6.98), (1.01, 7.5), (0.56, 7.5)]
    plastic = box(0, 7.75, 1.01, 9.01, car.bumpers, "trim")
    return [
        polygon(lamp, _RED, "light"),
        box(0, 7.35, 0.3, 7.65, _PLATE, "plate"),
        plastic if car.plastic else box(0, 8.3, 0.7, 9.01, BLACK, "trim"),
    ]


def _cladding(car: CarTraits) -> list[Decal]:
    s = car.shape
    top = s.bumper + 0.3 * (s.nose - s.bumper)
    return _kept(
        (True, box(0, 0, s.length, s.sill + 0.05, car.trim, "trim")),
        (car.plastic, box(0, 0, s.length, s.sill + 0.12, car.trim, "trim")),
        (car.plastic, box(-0.1, 0, s.front_wheel - 0.2, top, car.bumpers, "trim")),
        (car.plastic, box(s.rear_wheel + 0.2, 0, s.length + 0.1, top, car.bumpers, "trim")),
    )


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


def _doors(car: CarTraits, lines: BodyLines) -> list[Decal]:
    edges = _door_edges(car)
    low = car.shape.sill + 0.08
    waist = [lines.waist[np.argmin(np.abs(lines.waist[:, 2] - at)), 1] for at in edges]
    handle = CHROME if car.chances[3] < 0.3 else car.trim
    middle = 0.55 * waist[0] + 0.45 * car.shape.sill
    decals = [line(at, low, at, high, (0.03, 0), 0.5) for at, high in zip(edges, waist, strict=True)]
    for at, high in zip(edges[1:], waist[1:], strict=True):
        decals.append(box(at - 0.27, high - 0.12, at - 0.1, high - 0.08, handle, "trim"))
    return [*decals, line(edges[0], middle, edges[-1] + 0.3, middle + 0.04, (0, 0.03), 0.8)]


def _windows(car: CarTraits, lines: BodyLines) -> list[Decal]:
    if car.style == "jeep_open":
        return []
    waist, edge = (
        {t: side[round(t * 20), 2:0:-1] for t in stations}
        for side, stations in ((lines.waist, (3.5, 4.2, 5.0, 5.5)), (lines.edge, (3.6, 3.95, 4.4, 4.9, 5.25)))
    )
    up, down = np.array([0.0, 0.035]), np.array([0.0, 0.05])
    ahead = np.array([0.09, -0.02])
    corners = np.array([
        waist[3.5] + up, waist[4.2] + up, waist[5.0] + up, waist[5.5] + up, edge[5.25] - down - (0.06, 0),
        edge[4.9] - down, edge[4.4] - down, edge[3.95] - down + (0.05, 0), edge[3.6] + ahead,
    ])  # fmt: skip
    outline = corners + 0.035 * np.sign(corners - corners.mean(axis=0))
    decals = [
        polygon(outline, CHROME if car.name == "limousine" else BLACK, "trim"),
        polygon(corners, car.glass, "window"),
    ]
    edges = _door_edges(car)
    if car.style == "van" and car.chances[6] < 0.6:  # a panel instead of windows
        right, top = outline.max(axis=0)
        return [*decals, box(edges[-1], outline[0, 1], right, top, car.paint, "body")]
    post = BLACK if car.chances[7] < 0.5 else car.paint
    for at in edges[1:]:
        if corners[0, 0] + 0.2 < at < corners[3, 0] - 0.1:
            low, high = _span(corners, at)
            decals.append(box(at - 0.045, low, at + 0.045, high, post, "body" if post != BLACK else "trim"))
    return decals


def _span(corners: ndarray, u: float) -> tuple[float, float]:
    """Lowest and highest v at which the line u crosses a polygon."""
    ends = np.roll(corners, -1, axis=0)
    crossed = (corners[:, 0] > u) != (ends[:, 0] > u)
    a, b = corners[crossed], ends[crossed]
    v = a[:, 1] + (b[:, 1] - a[:, 1]) * (u - a[:, 0]) / (b[:, 0] - a[:, 0])
    return float(v.min()), float(v.max())


def _side_lamps(car: CarTraits, lines: BodyLines) -> list[Decal]:
    low, high = (1.75, 2.05) if car.chances[4] < 0.4 else (1.55, 2.02)
    if car.name == "sports":
        low, high = 2.0, 2.4
    (_, ay, az), (_, by, bz) = lines.edge[round(low * 20)], lines.edge[round(high * 20)]
    front = [(az - 0.1, ay), (az + 0.12, ay + 0.01), (bz + 0.26, by - 0.03), (bz - 0.1, by + 0.05)]
    (_, ay, az), (_, by, bz) = lines.edge[round(7.5 * 20)], lines.edge[round(7.0 * 20)]
    rear = [(az + 0.1, ay), (az - 0.12, ay + 0.02), (bz - 0.22, by - 0.06), (bz + 0.1, by + 0.02)]
    return _kept((car.name != "jeep", polygon(front, _LAMP, "light")), (True, polygon(rear, _RED, "light")))


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
        checker((0.62, 2.1, 1.01, 2.95), (0.39, 0.215), _BLUE, 1),
        *_word(2.5, 0.46, 0.24, _BLUE),
        box(0.5, 6.15, 1.01, 6.95, _YELLOW),
    ]


def _side_livery(car: CarTraits) -> list[Decal]:
    s = car.shape
    low, high = s.sill + 0.16, s.cowl - 0.12
    if car.name == "ambulance":
        return [box(0, low + 0.1, s.length, low + 0.4, _AMBULANCE[car.livery])]
    if car.name == "limousine":
        return [line(0.3, high, s.length - 0.3, high, (0, 0.045), 2.0 if sum(car.paint) < 1.0 else 0.6)]
    if car.name != "police":
        return []
    if car.livery == 0:
        edges = _door_edges(car)
        return [box(edges[0], 0, edges[-1], 3.0, WHITE)]
    if car.livery == 1:
        return [box(0.2, low + 0.12, s.length - 0.2, high, _BLUE)]
    band, field = (0.1, low, s.length - 0.1, high), 0.5 * (high - low)
    return [box(*band, _YELLOW), checker(band, (2.2 * field, field), _BLUE)]


def ambulance_box_paint(
    car: CarTraits, low: float, high: float, front: float, rear: float
) -> tuple[list[Decal], list[Decal], list[Decal]]:
    """An ambulance's box from above, from the front, and from the side: stripe, fields or band, sign,
    window."""
    middle, stripe = 0.5 * (front + rear), _AMBULANCE[car.livery]
    band = (front, low + 0.25, rear, low + 0.62)
    side = [
        box(*band, stripe),
        *_kept((car.livery == 2, checker(band, (0.45, 0.185), (0.10, 0.48, 0.20)))),
        *_sign(car, middle + 0.35, low + 1.12, 0.24, 0.24),
        box(front + 0.25, low + 1.0, front + 0.95, low + 1.4, car.glass, "window"),
        box(front, high - 0.2, rear, high - 0.12, stripe),
    ]
    return _sign(car, 0.0, middle, 0.62, 0.72), [box(0.0, high - 0.34, 0.7, high - 0.16, stripe)], side


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
