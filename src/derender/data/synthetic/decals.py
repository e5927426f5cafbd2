"""Paint of cars: a colour, and flat shapes (decals) on a chart, looked up at every sample of a pixel.

Numba's cache on disk refers to named tuples by name: who renames one renames the kernels that take it.
"""

from typing import NamedTuple

import numpy as np
from numpy import ndarray

from derender.render.numba_threads import kernel

SAMPLES = 3  # of a pixel, in each direction
_ALL = SAMPLES * SAMPLES
_ONE, _ZERO = np.float32(1.0), np.float32(0.0)
# columns of a decal: kind, multiplies, part (-1: that below), colour, bounds, then its own numbers: corners
# of a polygon (the kind is their count), or of an ellipse the hollow share of its radius, and how many gaps
# like those between spokes it has, each how large a share of the circle.
BOX, ELLIPSE = 0, 1
_MULTIPLIES, _PART, _COLOUR, _BOUNDS, _OWN = 1, 2, 3, 6, 10
MOST_CORNERS = 9
DECAL_LENGTH = _OWN + 2 * MOST_CORNERS


class Paint(NamedTuple):
    """Surfaces as arrays: k has rows ``first[k]`` to ``first[k + 1]`` of ``decals``."""

    colour: ndarray  # (surfaces, 3) float32
    part: ndarray  # (surfaces,) int32
    holes: ndarray  # (surfaces, 2, 3) float32: circles (u, v, radius) without surface; of radius 0 for none
    first: ndarray  # (surfaces + 1,) int32
    decals: ndarray  # (decals, DECAL_LENGTH) float32


NO_PAINT = Paint(
    *(np.zeros((1, 3), np.float32), np.zeros(1, np.int32), np.zeros((1, 2, 3), np.float32)),
    *(np.zeros(2, np.int32), np.zeros((0, DECAL_LENGTH), np.float32)),
)


@kernel
def paint_samples(paint, surface, spot, inside, colour, part):
    """Fill in colour and part of a pixel's samples, surface by surface."""
    current = -1
    for start in range(np.uint32(_ALL)):
        if surface[start] == current or surface[start] < 0:
            continue
        current = surface[start]
        low_p, low_q = np.float32(np.inf), np.float32(np.inf)
        high_p, high_q = -low_p, -low_q
        for s in range(np.uint32(_ALL)):
            if surface[s] == current:
                low_p, high_p = min(low_p, spot[0, s]), max(high_p, spot[0, s])
                low_q, high_q = min(low_q, spot[1, s]), max(high_q, spot[1, s])
                part[s] = paint.part[current]
                for n in range(3):
                    colour[s, n] = paint.colour[current, n]
        for d in range(np.uint32(paint.first[current]), np.uint32(paint.first[current + 1])):
            decal = paint.decals[d]
            outside = high_p < decal[_BOUNDS] or high_q < decal[_BOUNDS + 1]
            if outside or low_p > decal[_BOUNDS + 2] or low_q > decal[_BOUNDS + 3]:
                continue
            _cover(decal, spot, inside)
            for s in range(np.uint32(_ALL)):
                if inside[s] and surface[s] == current:
                    for n in range(3):
                        below = colour[s, n] if decal[_MULTIPLIES] > _ZERO else _ONE
                        colour[s, n] = below * decal[_COLOUR + n]
                    if decal[_PART] >= _ZERO:
                        part[s] = int(decal[_PART])


@kernel
def _cover(decal, spot, inside):
    """Which of a pixel's samples a shape holds."""
    kind = np.uint32(decal[0])
    if kind > ELLIPSE:
        inside[:] = False
        x0, y0 = decal[_OWN + 2 * kind - 2], decal[_OWN + 2 * kind - 1]
        for k in range(kind):
            x, y = decal[_OWN + 2 * k], decal[_OWN + 1 + 2 * k]
            slope = (x0 - x) / (y0 - y) if y0 != y else _ZERO
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
        if inside[s] and kind == ELLIPSE:
            x, y = (p + p - u0 - u1) / (u1 - u0), (q + q - v0 - v1) / (v1 - v0)
            away, turn = x * x + y * y, _ZERO
            if decal[_OWN + 1] > _ZERO:
                turn = np.arctan2(y, x) / np.float32(2.0 * np.pi) * decal[_OWN + 1]
            hollow = decal[_OWN] * decal[_OWN]
            inside[s] = hollow <= away <= _ONE and turn - np.floor(turn) < decal[_OWN + 2]
