"""What marks a police car, an ambulance and a sports car: colours and patterns painted over the body's.

The patterns are of the usual kinds (black and white, a blue band, blue and yellow fields, orange stripes and
a cross or a six-pointed star); none is that of an existing service. Leaves out lettering that can be read.
"""

import numpy as np

from derender.data.synthetic.car_body import body_lines
from derender.data.synthetic.car_decals import Colour, Decal, box, checker, line, polygon
from derender.data.synthetic.car_paint import BLACK, door_edges
from derender.data.synthetic.car_traits import CarTraits

WHITE: Colour = (0.93, 0.93, 0.92)
BLUE: Colour = (0.06, 0.18, 0.70)
YELLOW: Colour = (0.88, 0.90, 0.12)
ORANGE: Colour = (0.92, 0.30, 0.06)
CROSS_RED: Colour = (0.82, 0.06, 0.07)


def top_livery(car: CarTraits) -> list[Decal]:
    """Shapes over the top's paint and under its glass."""
    if car.name == "police":
        return _police_top(car)
    if car.name == "ambulance":
        stripe = (ORANGE, CROSS_RED, YELLOW)[car.livery]
        return [box(0, 1.98, 1.01, 2.22, stripe), *_word(0.0, 2.5, 0.5, 0.28, stripe)]
    if car.name == "sports" and car.chances[8] < 0.45:
        stripe = WHITE if sum(car.paint) < 1.9 else BLACK
        return [box(0.10, 1.7, 0.30, 9.0, stripe)]
    return []


def side_livery(car: CarTraits) -> list[Decal]:
    """Shapes over the sides' paint and under their windows."""
    s = car.shape
    low, high = s.sill + 0.16, s.cowl - 0.12
    if car.name == "police":
        lines = body_lines(s, np.linspace(0.0, 9.0, 181))
        edges = door_edges(car, lines)
        if car.livery == 0:
            return [box(edges[0], 0, edges[-1], 3.0, WHITE)]
        if car.livery == 1:
            return [box(0.2, low + 0.12, s.length - 0.2, high, BLUE)]
        field = 0.5 * (high - low)
        return [
            box(0.1, low, s.length - 0.1, high, YELLOW),
            checker((0.1, low, s.length - 0.1, high), (2.2 * field, field), BLUE),
        ]
    if car.name == "ambulance":
        return [box(0, low + 0.1, s.length, low + 0.4, (ORANGE, CROSS_RED, YELLOW)[car.livery])]
    if car.name == "limousine":
        return [line(0.3, high, s.length - 0.3, high, (0, 0.045), 2.0 if sum(car.paint) < 1.0 else 0.6)]
    return []


def box_side_livery(car: CarTraits, low: float, high: float, front: float, rear: float) -> list[Decal]:
    """An ambulance's box from the side: stripe, fields or band, sign, window."""
    middle, half = 0.5 * (front + rear), 0.24
    stripe = (ORANGE, CROSS_RED, YELLOW)[car.livery]
    decals = [box(front, low + 0.25, rear, low + 0.62, stripe)]
    if car.livery == 2:
        field = 0.185
        decals.append(checker((front, low + 0.25, rear, low + 0.62), (0.45, field), (0.10, 0.48, 0.20)))
    decals += _sign(car, middle + 0.35, low + 1.12, half, half)
    decals.append(box(front + 0.25, low + 1.0, front + 0.95, low + 1.4, car.glass, "window"))
    decals.append(box(front, high - 0.2, rear, high - 0.12, stripe))
    return decals


def box_top_livery(car: CarTraits, front: float, rear: float) -> list[Decal]:
    """The box from above: a large sign."""
    return _sign(car, 0.0, 0.5 * (front + rear), 0.62, 0.72)


def box_front_livery(car: CarTraits, low: float, high: float) -> list[Decal]:
    """The box from the front, above the cab."""
    stripe = (ORANGE, CROSS_RED, YELLOW)[car.livery]
    return [box(0.0, high - 0.34, 0.7, high - 0.16, stripe)]


def _sign(car: CarTraits, u: float, v: float, half_u: float, half_v: float) -> list[Decal]:
    """A red cross, or a blue star of six arms."""
    if car.livery != 0:
        arm = 0.32
        return [
            box(u - arm * half_u, v - half_v, u + arm * half_u, v + half_v, CROSS_RED),
            box(u - half_u, v - arm * half_v, u + half_u, v + arm * half_v, CROSS_RED),
        ]
    decals = []
    for turn in np.pi * np.array([0.0, 1.0, 2.0]) / 3.0:
        along = np.array([half_u * np.sin(turn), half_v * np.cos(turn)])
        across = 0.17 * np.array([half_u * np.cos(turn), -half_v * np.sin(turn)])
        arm = np.array([along + across, along - across, -along - across, across - along])
        decals.append(polygon(arm + np.array([u, v]), BLUE))
    return decals


def _police_top(car: CarTraits) -> list[Decal]:
    if car.livery == 0:
        roof = [box(0, 3.9, 1.01, 5.25, WHITE)]
        return [*roof, *_word(0.0, 2.5, 0.5, 0.22, WHITE)]
    if car.livery == 1:
        return [
            polygon([(0, 2.1), (1.01, 2.1), (1.01, 2.42), (0, 2.9)], BLUE),
            box(0, 6.15, 1.01, 6.95, BLUE),
            *_word(0.0, 2.42, 0.42, 0.18, WHITE),
        ]
    return [
        box(0.62, 2.1, 1.01, 2.95, YELLOW),
        checker((0.62, 2.1, 1.01, 2.95), (0.39, 0.215), BLUE, 1),
        *_word(0.0, 2.5, 0.46, 0.24, BLUE),
        box(0.5, 6.15, 1.01, 6.95, YELLOW),
    ]


def _word(u: float, v: float, half: float, tall: float, colour: Colour) -> list[Decal]:
    """Bars that look like a word from afar, symmetric about the middle."""
    pitch = half / 3.0
    return [
        box(u + pitch * (k + 0.14), v - tall / 2, u + pitch * (k + 0.86), v + tall / 2, colour)
        for k in range(3)
    ]
