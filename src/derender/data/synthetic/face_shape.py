"""The geometry of the built-in faces: their domain, the mean head, and how people and expressions move it.

A face is a grid of free 3D points, rows (down the face) times columns (around the head). Column angle
``theta`` turns around the vertical axis of the head (0 = the middle of the face, positive to the right of the
image). Row coordinate ``q`` runs down the face. ``p`` is the sideways coordinate in which features are
placed: like x near the front, the arc length further back. Unit: one pixel of a 64-pixel image at z = 1. All
shapes are smooth functions of this domain, so a finer grid shows the same face in more detail.

Points have the camera's axes. The mean head is elliptic sections plus hills. They were fitted to the average
neutral surface of ICT-FaceKit (MIT licence; 0.2 face pixels rms). Numbers stand in ``faces.yaml``. Leaves out
the back of the head, the tongue's motion, blinks, and puckered lips.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray
from scipy.interpolate import PchipInterpolator

from derender.data.synthetic.mesh_image import unit
from derender.data.synthetic.settings import numbers_of

THETA_MAX = np.deg2rad(112.0)
Q_TOP, Q_BOTTOM = -51.0, 58.0
MOUTH_Q = 14.0
MOUTH_BAND = 0.35  # half height of the closed mouth's line, which opens into the mouth's inside
EYE_P, EYE_Q = 12.2, -14.0
_HEAD_RADIUS = 26.0
_EAR_PLANE = 30.0  # z of the widest section
_TOO_LITTLE = 0.002  # face pixels
ACTIONS = tuple(numbers_of("faces")["actions"])
LID_ACTIONS = ("wide", "squint")  # drawn with the eyes


@dataclass(frozen=True)
class FaceGrid:
    """Domain coordinates of every vertex: ``theta`` in radians, ``p`` and ``q`` in face pixels."""

    theta: Float[ndarray, "rows columns"]
    p: Float[ndarray, "rows columns"]
    q: Float[ndarray, "rows columns"]

    def bump(self, p: Any, q: Any, wide: Any, high: Any) -> Float[ndarray, "*many rows columns"]:
        """A Gaussian hill of height 1 at (p, q), and its mirror image at (-p, q)."""
        return np.exp(-0.5 * (((np.abs(self.p) - p) / wide) ** 2 + ((self.q - q) / high) ** 2))


@dataclass(frozen=True)
class FaceShape:
    """A linear family of surfaces (rows, columns, 3) in face pixels."""

    grid: FaceGrid
    mean: Float[ndarray, "rows columns 3"]  # the mean head without ears; symmetric
    ear: Float[ndarray, "rows columns 3"]  # displacement by ears, kept apart because hair may cover them
    outward: Float[ndarray, "rows columns 3"]  # out of the bare head, level below the ears, where hair hangs
    reach: Float[ndarray, "rows 1"]  # half width of the bare head
    names: tuple[str, ...]  # of the modes: one displacement per trait of shape
    modes: Float[ndarray, "modes rows columns 3"]
    actions: list[Float[ndarray, "rows columns 3"]]  # displacement by left and right half of each of ACTIONS


@dataclass(frozen=True)
class Expression:
    """What one image's draw does to a face: ``sides`` are weights of each half of ACTIONS and LID_ACTIONS,
    ``gaze`` is in face pixels."""

    name: str
    strength: float
    sides: Float32[ndarray, "actions 2"]
    gaze: Float32[ndarray, "2"]


@lru_cache(maxsize=4)
def face_shape(detail: float = 1.0) -> FaceShape:
    """The family on a grid with ``detail`` times the rows and columns that suit a 64-pixel image."""
    numbers, grid = numbers_of("faces"), _grid(detail)
    fields, head = named_fields(grid), _bare_head(grid)
    left = 1.0 - smoothstep(-4.0, 4.0, grid.p)[..., None]
    actions = []
    for name in ACTIONS:
        whole = _displacement(grid, fields, numbers["actions"][name])
        for half in (whole * left, whole * (1.0 - left)):
            actions.append(np.where(np.abs(half) >= _TOO_LITTLE, half, 0.0).astype(np.float32))
    modes = [_displacement(grid, fields, terms) for terms in numbers["modes"].values()]
    normal = unit(np.cross(np.gradient(head, axis=0), np.gradient(head, axis=1)))
    level = np.stack([np.sin(grid.theta), np.zeros(grid.p.shape), -np.cos(grid.theta)], axis=-1)
    low = smoothstep(2.0, 20.0, grid.q)[..., None]
    return FaceShape(
        grid,
        mean=_mean_head(grid, head).astype(np.float32),
        ear=_ear(grid).astype(np.float32),
        outward=unit((1.0 - low) * normal + low * level).astype(np.float32),
        reach=np.abs(head[..., 0]).max(axis=1, keepdims=True).astype(np.float32),
        names=tuple(numbers["modes"]),
        modes=np.array(modes, np.float32),
        actions=actions,
    )


def smoothstep(low: float | ndarray, high: float | ndarray, value: ndarray) -> ndarray:
    """0 below ``low``, 1 above ``high``, a cubic with zero slope at both ends between."""
    t = np.clip((value - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def hill(value: ndarray, middle: Any, width: Any, power: int = 2) -> ndarray:
    """exp(-((value - middle) / width)^power): 1 in the middle, flatter there the higher the power."""
    return np.exp(-(((value - middle) / width) ** power))


def gauss(value: ndarray, middle: Any, sd: Any) -> ndarray:
    return np.exp(-0.5 * ((value - middle) / sd) ** 2)


def _grid(detail: float) -> FaceGrid:
    """Vertices are closer together where the face has detail."""
    q, theta = np.linspace(Q_TOP, Q_BOTTOM, 8001), np.linspace(0.0, THETA_MAX, 8001)
    mouth = 1.0 * hill(q, MOUTH_Q, 4.0) + 16.0 * hill(q, MOUTH_Q, 0.4, 4)
    eyes_and_middle = 0.6 + 2.6 * hill(q, -15.5, 5.5, 4) + 1.0 * hill(q, 3.0, 22.0, 4)
    q = _spaced(q, eyes_and_middle + mouth - 0.3 * smoothstep(36.0, 44.0, q), round(116 * detail))
    density = 1.0 + 1.6 * hill(theta, 0.0, 0.62, 4) + 1.2 * hill(theta, 1.52, 0.22)
    half = _spaced(theta, density, round(48 * detail) + 1)
    turn = np.deg2rad(55.0)
    away = _HEAD_RADIUS * (np.sin(np.minimum(half, turn)) + np.cos(turn) * np.maximum(half - turn, 0.0))
    theta, p = (np.concatenate([-side[:0:-1], side]) for side in (half, away))
    return FaceGrid(*(each.copy() for each in np.broadcast_arrays(theta, p, q[:, None])))


def _spaced(fine: ndarray, density: ndarray, count: int) -> ndarray:
    """``count`` increasing values over the same range, locally as close together as ``density``."""
    mass = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
    return np.interp(np.linspace(0.0, mass[-1], count), mass, fine)


def _displacement(grid: FaceGrid, fields: dict[str, ndarray], terms: list[list[Any]]) -> ndarray:
    """The sum of terms as ``faces.yaml`` writes them."""
    out = np.zeros((*grid.p.shape, 3))
    for axis, weight, *factors in terms:
        values = [fields[factor] if isinstance(factor, str) else grid.bump(*factor) for factor in factors]
        out[..., "xyz".index(axis)] += weight * np.prod(values, axis=0)
    return out


def named_fields(grid: FaceGrid) -> dict[str, Float[ndarray, "rows columns"]]:
    """Fields by the names that terms have in ``faces.yaml``; lines of age in face pixels."""
    p, q = np.abs(grid.p), grid.q
    wave = np.sin(2.0 * np.pi * (q + 25.0 + 0.5 * np.cos(p / 6.0)) / 3.1)
    away, level = p - 17.4, q - EYE_Q
    fan = np.sin(9.0 * np.arctan2(level, np.maximum(away, 0.05) + 1.5))
    below_line = smoothstep(MOUTH_Q - MOUTH_BAND, MOUTH_Q + MOUTH_BAND, q)
    lens = np.sqrt(np.clip(1.0 - (p / 9.2) ** 2, 0.0, 1.0))
    hinge = hill(p, 0.0, 24.0, 4) * (1.0 - smoothstep(33.0, 52.0, q))
    steps = {name: smoothstep(low, high, q) for name, (low, high) in numbers_of("faces")["steps"].items()}
    return {
        **steps,
        "fold": 0.3 * _fold(p, q, 4.6, 1.0),  # the lines of age
        "forehead_lines": 0.12 * wave * hill(q, -26.0, 4.6, 4) * hill(p, 0.0, 15.0, 4),
        "crows_feet": 0.16 * fan * hill(away, 2.2, 2.4, 4) * hill(level, 0.0, 3.6, 4),
        "p": grid.p,
        "side": np.sin(grid.theta),
        "sideways": np.tanh(grid.p / 3.0),
        "sideways_sharp": np.tanh(grid.p / 2.0),
        "sideways_wide": np.tanh(grid.p / 5.0),
        "hinge": hinge,
        "drop": ((1.0 - lens) * smoothstep(5.0, 25.0, q) + lens * below_line) * hinge,
        "inside": hill(q, MOUTH_Q, 0.9 * MOUTH_BAND, 4) * lens,
        "upper_side": (1.0 - below_line) * lens * gauss(q, MOUTH_Q, 3.0),
        "lower_side": below_line * lens * gauss(q, MOUTH_Q, 4.0),
        "smile_fold": 0.75 * _fold(p, q, 5.6, 0.8),
        "nose_wrinkles": np.sin(2.0 * np.pi * (q + 11.0) / 3.0),
        "brow_middle": hill(p, 0.0, 9.0, 4),
        "wrinkle": np.sin(2.0 * np.pi * (q + 25.0) / 2.6) * hill(q, -24.3, 2.6, 4) * hill(p, 0.0, 13.0, 4),
    }


def _fold(p: ndarray, q: ndarray, reach: float, depth: float) -> ndarray:
    """The crease from the nose's wing to the mouth's corner, ``reach`` further out below."""
    centre = 6.3 + reach * np.clip((q - 0.5) / 11.5, 0.0, 1.0) ** 0.8
    profile = depth * gauss(p, centre, 1.1) - 0.6 * gauss(p, centre + 2.4, 1.8)
    return profile * hill(q, 6.5, 6.5, 4)


def _bare_head(grid: FaceGrid) -> Float[ndarray, "rows columns 3"]:
    """Skull, jaw and neck without features: elliptic sections, lifted at the sides to follow the jaw line."""
    sections = np.array(numbers_of("faces")["sections"])
    profile = PchipInterpolator(sections[:, 0], sections[:, 1:])(np.minimum(grid.q, 34.0))
    width, front = profile[..., 0], profile[..., 1]
    sin, cos = np.sin(grid.theta), np.cos(grid.theta)
    turn = np.abs(grid.theta) / np.deg2rad(73.0)
    lift = turn**2 / (1.0 + 0.25 * turn**4)
    down = np.minimum(grid.q, 34.0) - 14.5 * smoothstep(-6.0, 29.0, grid.q) * lift
    jaw = np.stack([width * sin, down, front + (_EAR_PLANE - front) * (1.0 - cos)], axis=-1)
    neck_width = 17.0 + 0.16 * np.maximum(grid.q - 40.0, 0.0)
    neck_front = 37.0 - 17.0 * cos + 0.12 * (grid.q - 36.0)
    neck = np.stack([neck_width * sin, grid.q - 1.0 - 8.0 * lift, neck_front], axis=-1)
    below = smoothstep(29.0, 36.0, grid.q)[..., None]
    return (1.0 - below) * jaw + below * neck


def _mean_head(grid: FaceGrid, head: ndarray) -> Float[ndarray, "rows columns 3"]:
    """The bare head with its relief, and what averages blur away: the lips' fullness, the line between them
    and their corners, nostrils; without ears."""
    p, q = np.abs(grid.p), grid.q
    height, *hills = np.array(numbers_of("faces")["relief"]).T[..., None, None]
    upper = 0.7 * hill(p, 0.0, 6.8, 4) * gauss(q, 12.4, 1.0)
    lower = 0.9 * hill(p, 0.0, 6.2, 4) * gauss(q, 16.0, 1.3)
    line = 1.1 * np.clip(1.0 - (p / 10.0) ** 4, 0.0, 1.0) * gauss(q, MOUTH_Q, 1.6 * MOUTH_BAND)
    holes = 0.5 * grid.bump(9.6, MOUTH_Q, 1.2, 1.5) + 0.6 * grid.bump(2.4, 3.1, 1.0, 0.6)
    lifted = head[..., 1] - head[:, p.shape[1] // 2, None, 1]  # by the jaw line's rise: a mouth is level
    down = head[..., 1] - 0.85 * lifted * hill(q, 14.5, 5.0) * hill(p, 0.0, 13.0, 4)
    away = head[..., 2] + (height * grid.bump(*hills)).sum(axis=0) - upper - lower + line + holes
    return np.stack([head[..., 0], down, away], axis=-1)


def _ear(grid: FaceGrid) -> Float[ndarray, "rows columns 3"]:
    """Displacement that folds an ear out of the side of the head."""
    away, side, middle = ear_angle(grid), np.sign(grid.theta), grid.q + 5.5
    height = np.exp(-((np.abs(middle) / 7.8) ** 3.2)) * (1.0 - 0.022 * middle)
    rise = height * smoothstep(-0.16, 0.03, away) * (1.0 - smoothstep(0.06, 0.22, away))
    bowl = gauss(away, -0.075, 0.045) * gauss(middle, 0.0, 4.0)
    return np.stack([side * (4.0 * rise - bowl), np.zeros(rise.shape), -1.5 * rise], axis=-1)


def ear_angle(grid: FaceGrid) -> Float[ndarray, "rows columns"]:
    """Angle of a point behind the line at which the ear stands, which is slanted; radians."""
    return np.abs(grid.theta) - np.deg2rad(86.0) + np.deg2rad(0.35) * (grid.q + 5.5)
