"""Hair of the procedural face: where it grows, how far it stands off, and beards.

Hair is part of the head's surface: it grows above a line around the head, given as a row ``q`` for each
angle, and lifts the surface by its thickness, with a soft, uneven edge. Leaves out single strands, plaits,
and hair that hangs free of the head.
"""

from dataclasses import dataclass

import numpy as np
from numpy import ndarray
from scipy.interpolate import PchipInterpolator

from derender.data.synthetic.face_grid import FaceGrid, smoothstep

_TURNS_DEG = (0.0, 15.0, 30.0, 42.0, 50.0, 57.0, 63.0, 70.0, 78.0, 86.0, 96.0, 104.0, 115.0)
# Rows of the line at those angles, relative to the forehead's hair line in front of the temple.
_SHORT = (0.0, -0.2, -1.2, -2.2, -0.5, 5.5, 15.0, 28.0, 24.0, 17.0, 21.0, 36.0, 46.0)
_CURTAIN = (0.0, 0.4, 2.0, 6.0, 13.0, 27.0, 58.0, 95.0, 110.0, 120.0, 120.0, 120.0, 120.0)
_CROWN = (-30.0, -30.0, -30.0, -28.0, -24.0, -14.0, 4.0, 22.0, 20.0, 15.0, 19.0, 34.0, 44.0)


@dataclass(frozen=True)
class HairStyle:
    """Face pixels. ``top``, ``front``, ``side``, ``hang``: thickness on the crown, over the forehead's edge,
    over the ears, and below them; ``curl`` unevenness; ``cover`` opacity; ``fall`` how far a fringe falls;
    ``end`` the row at which hanging hair ends."""

    line: tuple[float, ...] = _SHORT
    top: float = 0.0
    front: float = 0.0
    side: float = 0.0
    hang: float = 0.0
    curl: float = 0.0
    cover: float = 1.0
    fall: float = 0.0
    end: float | None = None

    @property
    def covers_ears(self) -> bool:
        return self.side > 1.5


HAIR_STYLES: dict[str, HairStyle] = {
    "bald": HairStyle(cover=0.0),
    "receding": HairStyle(_CROWN, top=0.2, side=0.9, curl=0.1),
    "buzz": HairStyle(top=0.5, side=0.2, cover=0.7),
    "short": HairStyle(top=3.0, front=1.2, side=0.7, curl=0.12),
    "quiff": HairStyle(top=4.6, front=3.0, side=0.4, curl=0.15),
    "side part": HairStyle(top=3.4, front=1.8, side=0.9, fall=3.0),
    "fringe": HairStyle(top=3.2, front=1.4, side=0.9, fall=4.6),
    "curly": HairStyle(top=4.6, front=2.6, side=1.4, curl=0.6),
    "afro": HairStyle(top=6.5, front=4.2, side=5.0, curl=0.5),
    "tied": HairStyle(top=1.7, front=0.5, side=0.7),
    "bob": HairStyle(_CURTAIN, top=3.2, front=1.2, side=2.6, hang=1.0, end=32.0),
    "bob with fringe": HairStyle(_CURTAIN, top=3.2, front=1.2, side=2.6, hang=1.0, fall=5.5, end=31.0),
    "long": HairStyle(_CURTAIN, top=2.8, front=1.2, side=1.9, hang=2.0, fall=0.6),
    "long with fringe": HairStyle(_CURTAIN, top=2.8, front=1.2, side=1.9, hang=2.0, fall=5.5),
    "long wavy": HairStyle(_CURTAIN, top=3.6, front=1.6, side=3.0, hang=4.5, curl=0.12, fall=1.0),
}
_HANG = 27.5  # half width at which hair falls past jaw and neck
BEARDS = ("none", "stubble", "moustache", "goatee", "short beard", "full beard")


def hair_distance(
    grid: FaceGrid, style: HairStyle, line: float, recession: float, parting: float, wave: ndarray
) -> ndarray:
    """How far a point lies inside the hair (> 0) or outside it, in face pixels.

    ``line`` moves the hair line down, ``recession`` (0..1) back at the temples, ``parting`` (-1..1) is where
    the hair falls apart, ``wave`` (4,) shapes its unevenness.
    """
    if style.cover == 0.0:
        return np.full(grid.shape, -50.0)
    turn, p = np.rad2deg(grid.theta[0]), grid.p[0]
    away = np.abs(turn)
    front = -31.3 + line
    rows = np.array(style.line)
    if style.end is not None:
        rows = np.minimum(rows, style.end - front)
    limit = front + PchipInterpolator(_TURNS_DEG, rows)(away)
    limit -= 5.5 * recession * np.exp(-(((away - 30.0) / 14.0) ** 2)) + 2.5 * recession * (away < 90)
    parted = turn - 26.0 * parting
    falls = 1.0 - np.exp(-((parted / (12.0 if style.line is _CURTAIN else 20.0)) ** 2))
    if style.fall > 2.0:
        falls = 0.35 + 0.65 * falls if abs(parting) < 0.35 else falls
    limit += style.fall * falls * np.exp(-((away / 52.0) ** 6))
    limit += (
        (0.15 + 0.55 * wave[0])
        * (np.sin(0.30 * p + 6.3 * wave[1]) + 0.7 * np.sin(0.72 * p + 6.3 * wave[2]))
        * np.exp(-((away / 60.0) ** 6))
    )
    slope = np.gradient(limit, p)
    return (limit - grid.q) / np.sqrt(1.0 + slope**2)


def hair_thickness(
    grid: FaceGrid, style: HairStyle, volume: float, distance: ndarray, reach: ndarray
) -> ndarray:
    """How far hair stands off the head, face pixels; ``reach`` (rows, 1) is the bare head's half width, which
    hanging hair makes up for."""
    crown = 1.0 - smoothstep(-42.0, -26.0, grid.q)
    away = smoothstep(np.deg2rad(28.0), np.deg2rad(66.0), np.abs(grid.theta))
    full = crown * style.top + (1.0 - crown) * (style.front * (1.0 - away) + style.side * away)
    full *= volume
    if style.hang > 0.0:
        down = smoothstep(-4.0, 40.0, grid.q)
        full = (
            full
            + away * np.where(grid.q > -8.0, np.maximum(_HANG - reach, 0.0), 0.0)
            + style.hang * down * away
        )
    below = grid.q > 24.0
    edge = np.where(below, 4.0, 1.0 + 1.9 * np.clip(full, 0.3, 4.0))
    return full * smoothstep(-0.5, edge, distance)


def hair_forward(grid: FaceGrid, style: HairStyle, distance: ndarray) -> ndarray:
    """How far hanging hair comes forward of the neck, face pixels: it falls from the temples."""
    if style.hang == 0.0:
        return np.zeros(grid.shape)
    beside = smoothstep(np.deg2rad(46.0), np.deg2rad(62.0), np.abs(grid.theta))
    return 11.0 * beside * smoothstep(26.0, 36.0, grid.q) * smoothstep(-0.5, 4.0, distance)


def beard_amount(grid: FaceGrid, kind: str) -> ndarray:
    """Where a beard of this kind grows, 0..1; leaves the lips to the caller."""
    p, q = np.abs(grid.p), grid.q
    line = PchipInterpolator(
        [0.0, 3.0, 7.0, 10.0, 13.0, 17.0, 21.0, 24.0, 27.0, 31.0, 80.0],
        [18.9, 19.1, 18.6, 13.5, 11.5, 9.5, 4.5, -1.0, 6.0, 12.0, 12.0],
    )(p)
    soft = 5.0 if kind == "stubble" else 2.0
    cheeks = smoothstep(-soft, 1.6 * soft, q - line) * (1.0 - smoothstep(32.0, 37.0, q))
    moustache = (
        np.exp(-(((q - 9.6 - 0.030 * p**2) / 2.0) ** 4))
        * np.exp(-((p / 10.5) ** 6))
        * (1.0 - 0.45 * np.exp(-((p / 1.2) ** 2)))
    )
    chin = (
        smoothstep(-1.0, 1.5, q - np.maximum(line, 10.0))
        * np.exp(-((p / 9.5) ** 6))
        * (1.0 - smoothstep(31.0, 35.0, q))
    )
    return {
        "none": np.zeros(grid.shape),
        "moustache": moustache,
        "goatee": np.maximum(chin, moustache),
    }.get(kind, np.maximum(cheeks, moustache))
