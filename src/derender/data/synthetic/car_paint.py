"""What is painted on a car's body: windows, lamps, grille, plates, door lines, wheel arches.

Two charts: (share of the half width, station) on top, where one row of shapes suits every body style, and
(z, y) in metres beside, where windows follow the body's lines. Leaves out interiors behind the glass.
"""

import numpy as np
from numpy import ndarray

from derender.data.synthetic.car_body import BED_FROM, BED_SIDE, BED_TO, BodyLines, body_lines
from derender.data.synthetic.car_decals import Colour, Decal, box, line, polygon, ring, spokes
from derender.data.synthetic.car_traits import CarTraits

BLACK: Colour = (0.03, 0.03, 0.035)
CHROME: Colour = (0.72, 0.73, 0.75)
LAMP: Colour = (0.95, 0.95, 0.88)
AMBER: Colour = (0.95, 0.55, 0.08)
RED: Colour = (0.72, 0.04, 0.05)
PLATE: Colour = (0.93, 0.93, 0.90)
_TWO_PANES = ("sedan", "hatchback", "coupe", "sports")


def top_decals(car: CarTraits) -> list[Decal]:
    """Shapes on the front, bonnet, windscreen, roof, rear window, boot and rear."""
    decals = [*_roof(car), *_front(car), *_panels(car), *_glass(car), *_rear(car)]
    if car.shape.bed > 0:
        floor = (0.16, 0.15, 0.14) if car.style == "jeep_open" else (0.12, 0.12, 0.125)
        decals.append(box(0, BED_FROM + 0.005, BED_SIDE + 0.01, BED_TO + 0.005, floor, "trim"))
    return decals


def side_decals(car: CarTraits) -> list[Decal]:
    """Shapes on both sides."""
    s = car.shape
    lines = body_lines(s, np.linspace(0.0, 9.0, 181))
    decals = [*_cladding(car), *_doors(car, lines), *_windows(car, lines), *_side_lamps(car, lines)]
    for at in (s.front_wheel, s.rear_wheel):
        if car.bumpers != car.paint and car.name != "jeep":
            decals.append(ring(at, s.wheel, (1.36 * s.wheel, 1.36 * s.wheel), car.trim, "trim"))
        decals.append(ring(at, s.wheel, (1.17 * s.wheel, 1.17 * s.wheel), BLACK, "trim"))
    return decals


def wheel_decals(car: CarTraits) -> list[Decal]:
    rim = car.rim
    dark: Colour = (0.10, 0.10, 0.105)
    return [
        ring(0, 0, (0.72, 0.72), rim),
        spokes(car.spokes, 0.45, 0.24, 0.62, dark),
        ring(0, 0, (0.13, 0.13), (0.6 * rim[0], 0.6 * rim[1], 0.6 * rim[2])),
    ]


def station_of(lines: BodyLines, z: float) -> int:
    """The row of ``lines`` whose waist is nearest to z."""
    return int(np.argmin(np.abs(lines.waist[:, 2] - z)))


def front_station(car: CarTraits, height: float) -> float:
    """Where on the front face, between bumper (1) and nose (2), that height lies."""
    s = car.shape
    return 1.0 + (height - s.bumper) / (s.nose - s.bumper)


def _roof(car: CarTraits) -> list[Decal]:
    decals = []
    if car.roof != car.paint:
        decals.append(box(0, 3.95, 1.01, 5.2, car.roof, "body"))
    if car.chances[0] < 0.25 and car.name in ("sedan", "hatchback", "estate", "suv", "limousine"):
        decals.append(box(0, 4.22, 0.62, 4.55, car.glass, "window"))
    return decals


def _front(car: CarTraits) -> list[Decal]:
    if car.name == "jeep":
        return _jeep_front(car)
    low = 0.0 if car.bumpers != car.paint else 0.2
    decals = []
    if car.bumpers != car.paint:
        decals.append(box(0, 0, 1.01, 1.3, car.bumpers, "trim"))
    sports = car.name == "sports"
    wide = 0.78 if sports else 0.5 + 0.15 * car.chances[1]
    decals.append(box(0, 0.25 + low, wide, 0.95, BLACK, "trim"))
    if sports:
        decals.append(box(0, 0, 1.01, 0.28, BLACK, "trim"))
        decals.append(polygon([(0.5, 0.3), (0.9, 0.3), (0.86, 1.1), (0.56, 0.95)], BLACK, "trim"))
    else:
        decals.append(ring(0.78, 0.72, (0.08, 0.22), LAMP, "light"))
        grille = 0.36 + 0.16 * car.chances[2]
        if car.chances[3] < 0.6:
            decals.append(box(0, 1.36, grille + 0.04, 1.93, CHROME, "trim"))
        decals.append(box(0, 1.44, grille, 1.86, BLACK, "trim"))
        if car.chances[3] < 0.3:
            decals.append(box(0, 1.62, grille, 1.68, CHROME, "trim"))
        decals.append(ring(0, 1.66, (0.05, 0.12), CHROME, "trim"))
    decals += _head_lamps(car)
    decals.append(box(0, 1.02, 0.3, 1.3, PLATE, "plate"))
    return decals


def _head_lamps(car: CarTraits) -> list[Decal]:
    slim = car.name == "sports" or car.chances[4] < 0.4
    inner = 0.52 + 0.1 * car.chances[5]
    low, high = (1.72, 2.1) if slim else (1.5, 2.06)
    shape = [(inner, low + 0.12), (1.01, low), (1.01, high + 0.06), (inner + 0.03, high - 0.04)]
    if car.name == "sports":
        low, high = 1.9, 2.4
        shape = [(0.62, 1.92), (0.97, 1.95), (1.01, 2.5), (0.9, 2.42), (0.66, 2.12)]
    middle = 0.5 * (inner + 0.03 + 1.0)
    return [
        polygon(shape, (0.30, 0.31, 0.33), "light"),
        polygon(
            [
                (middle + 0.86 * (u - middle), 0.5 * (low + high) + 0.76 * (t - 0.5 * (low + high)))
                for u, t in shape
            ],
            LAMP,
            "light",
        ),
    ]


def _jeep_front(car: CarTraits) -> list[Decal]:
    tall = car.shape.nose - car.shape.bumper
    half = car.shape.width / 2 * 0.82
    slots = [box(u - 0.035, 1.16, u + 0.035, 1.82, BLACK, "trim") for u in (0.0, 0.15, 0.30, 0.45)]
    lamp = 0.105
    return [
        box(0, 0, 1.01, 0.96, car.trim, "trim"),
        *slots,
        ring(0.74, 1.5, (1.2 * lamp / half, 1.2 * lamp / tall), CHROME, "light"),
        ring(0.74, 1.5, (lamp / half, lamp / tall), LAMP, "light"),
        ring(0.95, 1.2, (0.05, 0.08), AMBER, "light"),
    ]


def _panels(car: CarTraits) -> list[Decal]:
    """Shut lines of bonnet and boot."""
    decals = [
        line(0.84, 2.12, 0.9, 2.97, (0.022, 0), 0.62),
        line(0, 2.1, 0.86, 2.14, (0, 0.05), 0.7),
        line(0.3, 2.2, 0.4, 2.95, (0.02, 0), 0.88),
    ]
    if car.style in ("sedan", "coupe", "sports"):
        decals.append(line(0.86, 6.1, 0.86, 6.97, (0.022, 0), 0.62))
    return decals


def _glass(car: CarTraits) -> list[Decal]:
    if car.style == "jeep_open":
        return []
    frame = BLACK if car.paint != BLACK else car.trim
    decals = [
        polygon([(0, 2.97), (0.95, 3.02), (0.93, 3.95), (0, 3.97)], frame, "trim"),
        polygon([(0, 3.05), (0.91, 3.1), (0.88, 3.88), (0, 3.9)], car.glass, "window"),
    ]
    if car.style not in ("van", "cab") or car.chances[6] < 0.5:
        low = 5.95 if car.style in ("sedan", "coupe", "sports") else 5.72
        decals.append(polygon([(0, 5.14), (0.86, 5.14), (0.9, low), (0, low)], car.glass, "window"))
    return decals


def _rear(car: CarTraits) -> list[Decal]:
    tall = car.style in ("estate", "suv", "van", "pickup", "hatchback", "jeep_hard", "jeep_open", "cab")
    lamp = (
        [(0.8, 7.0), (1.01, 6.85), (1.01, 7.85), (0.8, 7.7)]
        if tall
        else [(0.5, 7.12), (1.01, 6.98), (1.01, 7.5), (0.56, 7.5)]
    )
    decals = [polygon(lamp, RED, "light"), box(0, 7.35, 0.3, 7.65, PLATE, "plate")]
    if car.bumpers != car.paint:
        decals.append(box(0, 7.75, 1.01, 9.01, car.bumpers, "trim"))
    else:
        decals.append(box(0, 8.3, 0.7, 9.01, BLACK, "trim"))
    return decals


def _cladding(car: CarTraits) -> list[Decal]:
    s = car.shape
    decals = [box(0, 0, s.length, s.sill + 0.05, car.trim, "trim")]
    if car.bumpers != car.paint:
        decals.append(box(0, 0, s.length, s.sill + 0.12, car.trim, "trim"))
        top = s.bumper + 0.3 * (s.nose - s.bumper)
        decals.append(box(-0.1, 0, s.front_wheel - 0.2, top, car.bumpers, "trim"))
        decals.append(box(s.rear_wheel + 0.2, 0, s.length + 0.1, top, car.bumpers, "trim"))
    return decals


def door_edges(car: CarTraits, lines: BodyLines) -> list[float]:
    """Where doors begin and end along the car."""
    s = car.shape
    first = max(s.front_wheel + 1.2 * s.wheel, s.cowl_at + 0.05)
    last = s.cowl_at + (0.9 if car.style != "pickup" else 1.0) * (
        min(s.deck_at, s.rear_wheel + 0.35) - s.cowl_at
    )
    if car.style in ("coupe", "sports", "jeep_hard", "jeep_open", "pickup", "van", "cab"):
        door = {"van": 1.05, "cab": 1.0, "jeep_hard": 1.0, "jeep_open": 1.0}.get(car.style, 1.3)
        return [first, min(first + door, last)]
    if car.name == "limousine":
        return [first, first + 0.95, last - 1.0, last]
    return [first, 0.5 * (first + last) + 0.02, last]


def _doors(car: CarTraits, lines: BodyLines) -> list[Decal]:
    edges = door_edges(car, lines)
    low = car.shape.sill + 0.08
    decals = []
    for at in edges:
        decals.append(line(at, low, at, lines.waist[station_of(lines, at), 1], (0.03, 0), 0.5))
    for at in edges[1:]:
        high = lines.waist[station_of(lines, at), 1]
        decals.append(
            box(
                at - 0.27,
                high - 0.12,
                at - 0.1,
                high - 0.08,
                CHROME if car.chances[3] < 0.3 else car.trim,
                "trim",
            )
        )
    middle = 0.55 * lines.waist[station_of(lines, edges[0]), 1] + 0.45 * car.shape.sill
    decals.append(line(edges[0], middle, edges[-1] + 0.3, middle + 0.04, (0, 0.03), 0.8))
    return decals


def _windows(car: CarTraits, lines: BodyLines) -> list[Decal]:
    if car.style == "jeep_open":
        return []
    waist = {t: lines.waist[round(t * 20), 2:0:-1] for t in (3.4, 3.5, 4.2, 5.0, 5.5, 5.6)}
    edge = {t: lines.edge[round(t * 20), 2:0:-1] for t in (3.6, 3.95, 4.4, 4.9, 5.25)}
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
    edges = door_edges(car, lines)
    panel = car.style == "van" and car.chances[6] < 0.6
    if panel:
        behind = (edges[-1], outline[0, 1], outline[:, 0].max(), outline[:, 1].max())
        decals.append(box(*behind, car.paint, "body"))
    post = BLACK if car.chances[7] < 0.5 else car.paint
    for at in edges[1:] if not panel else ():
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
    decals = []
    if car.name not in ("jeep",):
        low, high = (1.75, 2.05) if car.name == "sports" or car.chances[4] < 0.4 else (1.55, 2.02)
        if car.name == "sports":
            low, high = 2.0, 2.4
        a, b = lines.edge[round(low * 20)], lines.edge[round(high * 20)]
        decals.append(
            polygon(
                [
                    (a[2] - 0.1, a[1]),
                    (a[2] + 0.12, a[1] + 0.01),
                    (b[2] + 0.26, b[1] - 0.03),
                    (b[2] - 0.1, b[1] + 0.05),
                ],
                LAMP,
                "light",
            )
        )
    a, b = lines.edge[round(7.5 * 20)], lines.edge[round(7.0 * 20)]
    decals.append(
        polygon(
            [
                (a[2] + 0.1, a[1]),
                (a[2] - 0.12, a[1] + 0.02),
                (b[2] - 0.22, b[1] - 0.06),
                (b[2] + 0.1, b[1] + 0.02),
            ],
            RED,
            "light",
        )
    )
    return decals
