"""The geometry of the built-in faces: their domain, the mean head, and how people and expressions move it.

A face is a grid of free 3D points, rows (down the face) times columns (around the head). Column angle
``theta`` turns around the vertical axis of the head (0 = the middle of the face, positive to the right of the
image); row coordinate ``q`` runs down the face. ``p`` is the sideways coordinate in which features are
placed: like x near the front, the arc length further back. Unit: one pixel of a 64-pixel image at z = 1, eyes
at (+-12, -14), mouth at (0, 14), as on a mean face. All shapes and skins are smooth functions of this domain,
so a finer grid shows the same face in more detail.

Points have the camera's axes: x right, y down, z away from the viewer. The mean head is elliptic sections
plus hills, whose heights, places and widths were fitted by least squares to the average neutral surface of
renders of a published morphable model (ICT-FaceKit, MIT licence; 0.2 face pixels rms). Numbers stand in
``faces.yaml``. Leaves out the back of the head, the tongue's motion, blinks, and puckered lips.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float, Int32, Int64
from numpy import ndarray
from scipy.interpolate import PchipInterpolator

THETA_MAX = np.deg2rad(112.0)
Q_TOP, Q_BOTTOM = -51.0, 58.0
MOUTH_Q = 14.0
MOUTH_BAND = 0.35  # half height of the closed mouth's line, which opens into the mouth's inside
EYE_P, EYE_Q = 12.2, -14.0
_HEAD_RADIUS = 26.0
_EAR_PLANE = 30.0  # z of the widest section
_TOO_LITTLE = 0.002  # face pixels
ACTIONS = (
    *("jaw_open", "lips_part", "smile", "cheek_raise", "frown", "stretch", "sneer", "press"),
    *("brow_inner_up", "brow_outer_up", "brow_lower"),
)
LID_ACTIONS = ("wide", "squint")  # drawn with the eyes


@dataclass(frozen=True)
class FaceGrid:
    """Domain coordinates of every vertex: ``theta`` in radians, ``p`` and ``q`` in face pixels."""

    theta: Float[ndarray, "rows columns"]
    p: Float[ndarray, "rows columns"]
    q: Float[ndarray, "rows columns"]

    @property
    def shape(self) -> tuple[int, int]:
        return self.theta.shape

    def bump(self, p: float, q: float, wide: float, high: float) -> Float[ndarray, "rows columns"]:
        """A Gaussian hill of height 1 at (p, q), and its mirror image at (-p, q)."""
        return np.exp(-0.5 * (((np.abs(self.p) - p) / wide) ** 2 + ((self.q - q) / high) ** 2))


@dataclass(frozen=True)
class FaceBasis:
    """A linear family of grids (rows, columns, 3) in face pixels.

    Attributes:
        mean: the mean head without ears; symmetric.
        ear: displacement by ears, kept apart because hair may cover them.
        names, modes: one displacement per trait of shape.
        actions: displacement by the left and the right half of each of ``ACTIONS``.
        boxes: rows and columns (first, last exclusive) where each half moves anything.
    """

    mean: Float[ndarray, "rows columns 3"]
    ear: Float[ndarray, "rows columns 3"]
    names: tuple[str, ...]
    modes: Float[ndarray, "modes rows columns 3"]
    actions: Float[ndarray, "actions two rows columns 3"]
    boxes: Int64[ndarray, "actions two 4"]


@lru_cache(maxsize=4)
def face_grid(detail: float = 1.0) -> FaceGrid:
    """The grid with ``detail`` times the rows and columns that suit a 64-pixel image; closer together where
    the face has detail."""
    half = _spaced(0.0, THETA_MAX, round(48 * detail) + 1, _column_density)
    theta = np.concatenate([-half[:0:-1], half])
    q = _spaced(Q_TOP, Q_BOTTOM, round(116 * detail), _row_density)
    turn = np.deg2rad(55.0)
    front = np.sin(np.minimum(half, turn))
    p_half = _HEAD_RADIUS * (front + np.cos(turn) * np.maximum(half - turn, 0.0))
    p = np.concatenate([-p_half[:0:-1], p_half])
    shape = (len(q), len(theta))
    return FaceGrid(*(np.broadcast_to(values, shape).copy() for values in (theta, p, q[:, None])))


def smoothstep(low: float | ndarray, high: float | ndarray, value: ndarray) -> ndarray:
    """0 below ``low``, 1 above ``high``, a cubic with zero slope at both ends between."""
    t = np.clip((value - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def hill(value: ndarray, middle: float | ndarray, width: float, power: int = 2) -> ndarray:
    """exp(-((value - middle) / width)^power): 1 in the middle, flatter there the higher the power."""
    return np.exp(-(((value - middle) / width) ** power))


def gauss(value: ndarray, middle: float | ndarray, sd: float) -> ndarray:
    return np.exp(-0.5 * ((value - middle) / sd) ** 2)


def _column_density(theta: ndarray) -> ndarray:
    return 1.0 + 1.6 * hill(theta, 0.0, 0.62, 4) + 1.2 * hill(theta, 1.52, 0.22)


def _row_density(q: ndarray) -> ndarray:
    mouth = 1.0 * hill(q, MOUTH_Q, 4.0) + 16.0 * hill(q, MOUTH_Q, 0.4, 4)
    eyes_and_middle = 0.6 + 2.6 * hill(q, -15.5, 5.5, 4) + 1.0 * hill(q, 3.0, 22.0, 4)
    return eyes_and_middle + mouth - 0.3 * smoothstep(36.0, 44.0, q)


def _spaced(low: float, high: float, count: int, density: Callable[[ndarray], ndarray]) -> ndarray:
    """``count`` increasing values from low to high, locally as close together as ``density`` says."""
    fine = np.linspace(low, high, 8001)
    mass = np.concatenate([[0.0], np.cumsum(0.5 * (density(fine)[1:] + density(fine)[:-1]))])
    return np.interp(np.linspace(0.0, mass[-1], count), mass, fine)


@lru_cache(maxsize=4)
def grid_triangles(rows: int, columns: int) -> Int32[ndarray, "f 3"]:
    """Two triangles a cell of a grid whose vertices are numbered row by row."""
    corner = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    upper, right, lower, across = corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]
    pairs = np.stack([upper, right, lower, right, across, lower], axis=-1)
    return np.ascontiguousarray(pairs.reshape(-1, 3))


@lru_cache(maxsize=1)
def _numbers() -> dict[str, Any]:
    return yaml.safe_load(Path(__file__).with_name("faces.yaml").read_text(encoding="utf-8"))


@lru_cache(maxsize=4)
def face_basis(detail: float = 1.0) -> FaceBasis:
    """Mean head, traits of shape and expressions, sampled on ``face_grid(detail)``."""
    grid, numbers = face_grid(detail), _numbers()
    fields = _named_fields(grid)
    modes = [_displacement(grid, fields, terms) for terms in numbers["modes"].values()]
    actions = np.stack([_displacement(grid, fields, numbers["actions"][name]) for name in ACTIONS])
    left = 1.0 - smoothstep(-4.0, 4.0, grid.p)[..., None]
    halves = np.stack([actions * left, actions * (1.0 - left)], axis=1)
    halves[np.abs(halves) < _TOO_LITTLE] = 0.0
    boxes = np.array([[_box(np.abs(half).max(axis=-1) > 0) for half in pair] for pair in halves], np.int64)
    single = [np.asarray(value, np.float32) for value in (mean_head(grid), ear(grid), modes, halves)]
    return FaceBasis(single[0], single[1], tuple(numbers["modes"]), single[2], single[3], boxes)


def _displacement(grid: FaceGrid, fields: dict[str, ndarray], terms: list[list[Any]]) -> ndarray:
    """The sum of terms as ``faces.yaml`` writes them."""
    out = np.zeros((*grid.shape, 3))
    for axis, weight, *factors in terms:
        value = weight
        for factor in factors:
            value = value * (fields[factor] if isinstance(factor, str) else grid.bump(*factor))
        out[..., "xyz".index(axis)] += value
    return out


def _box(moved: ndarray) -> tuple[int, int, int, int]:
    rows, columns = np.flatnonzero(moved.any(axis=1)), np.flatnonzero(moved.any(axis=0))
    return int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1


def _named_fields(grid: FaceGrid) -> dict[str, Float[ndarray, "rows columns"]]:
    p, q = np.abs(grid.p), grid.q
    below_line = smoothstep(MOUTH_Q - MOUTH_BAND, MOUTH_Q + MOUTH_BAND, q)
    lens = np.sqrt(np.clip(1.0 - (p / 9.2) ** 2, 0.0, 1.0))
    hinge = hill(p, 0.0, 24.0, 4) * (1.0 - smoothstep(33.0, 52.0, q))
    brow = gauss(q, -20.0, 3.6)
    brow_lines = np.sin(2.0 * np.pi * (q + 25.0) / 2.6)
    return {
        "p": grid.p,
        "side": np.sin(grid.theta),
        "sideways": np.tanh(grid.p / 3.0),
        "sideways_sharp": np.tanh(grid.p / 2.0),
        "sideways_wide": np.tanh(grid.p / 5.0),
        "upper": 1.0 - smoothstep(-18.0, 2.0, q),
        "lower": smoothstep(2.0, 22.0, q),
        "face_only": 1.0 - smoothstep(31.0, 42.0, q),
        "chin_down": smoothstep(0.0, 28.0, q),
        "above_neck": 1.0 - smoothstep(40.0, 56.0, q),
        "neck": smoothstep(31.0, 40.0, q),
        "forehead": 1.0 - smoothstep(-36.0, -20.0, q),
        "below_nose": smoothstep(4.0, 11.0, q),
        "bridge_columns": gauss(grid.p, 0.0, 2.2),
        "bridge_rows": gauss(q, -10.0, 4.5),
        "fold": _fold(p, q, 4.6, 1.0, 0.3),
        "forehead_lines": _forehead_lines(grid),
        "crows_feet": _crows_feet(p, q),
        "jaw_side": smoothstep(4.0, 18.0, q),
        "hinge": hinge,
        "drop": ((1.0 - lens) * smoothstep(5.0, 25.0, q) + lens * below_line) * hinge,
        "inside": np.exp(-((np.abs(q - MOUTH_Q) / (0.9 * MOUTH_BAND)) ** 4)) * lens,
        "upper_side": (1.0 - below_line) * lens * gauss(q, MOUTH_Q, 3.0),
        "lower_side": below_line * lens * gauss(q, MOUTH_Q, 4.0),
        "corner": grid.bump(9.2, MOUTH_Q, 4.2, 4.2),
        "cheek": grid.bump(14.0, 4.0, 4.2, 3.6),
        "smile_fold": _fold(p, q, 5.6, 0.8, 0.75),
        "nose_wrinkles": np.sin(2.0 * np.pi * (q + 11.0) / 3.0),
        "brow_rows": brow,
        "brow_inside": hill(p, 5.0, 7.0),
        "brow_middle": hill(p, 0.0, 9.0, 4),
        "inner_brow": hill(p, 3.0, 6.5) * brow,
        "wrinkle": brow_lines * hill(q, -24.3, 2.6, 4) * hill(p, 0.0, 13.0, 4),
    }


def wrinkles(grid: FaceGrid) -> dict[str, Float[ndarray, "rows columns"]]:
    """Where the lines of age lie, 0..1, for colouring them."""
    p, q = np.abs(grid.p), grid.q
    return {
        "fold": np.clip(_fold(p, q, 4.6, 1.0, 0.3) / 0.3, 0.0, 1.0),
        "forehead_lines": np.clip(_forehead_lines(grid) / 0.12, 0.0, 1.0),
        "crows_feet": np.clip(_crows_feet(p, q) / 0.16, 0.0, 1.0),
        "under_eye": grid.bump(10.5, -9.2, 4.0, 0.8),
    }


def _forehead_lines(grid: FaceGrid) -> ndarray:
    wave = np.sin(2.0 * np.pi * (grid.q + 25.0 + 0.5 * np.cos(grid.p / 6.0)) / 3.1)
    return 0.12 * wave * hill(grid.q, -26.0, 4.6, 4) * hill(grid.p, 0.0, 15.0, 4)


def _crows_feet(p: ndarray, q: ndarray) -> ndarray:
    away, level = p - 17.4, q - EYE_Q
    fan = np.arctan2(level, np.maximum(away, 0.05) + 1.5)
    return 0.16 * np.sin(9.0 * fan) * hill(away, 2.2, 2.4, 4) * hill(level, 0.0, 3.6, 4)


def _fold(p: ndarray, q: ndarray, reach: float, depth: float, height: float) -> ndarray:
    """The crease from the nose's wing to the mouth's corner, ``reach`` further out below."""
    centre = 6.3 + reach * np.clip((q - 0.5) / 11.5, 0.0, 1.0) ** 0.8
    profile = depth * gauss(p, centre, 1.1) - 0.6 * np.exp(-0.5 * ((p - centre - 2.4) / 1.8) ** 2)
    return height * profile * hill(q, 6.5, 6.5, 4)


def bare_head(grid: FaceGrid) -> Float[ndarray, "rows columns 3"]:
    """Skull, jaw and neck without features: elliptic sections, lifted at the sides to follow the jaw line."""
    rows, half_width, fronts = np.array(_numbers()["sections"]).T
    q = np.minimum(grid.q, 34.0)
    sin, cos = np.sin(grid.theta), np.cos(grid.theta)
    width, front = PchipInterpolator(rows, half_width)(q), PchipInterpolator(rows, fronts)(q)
    turn = np.abs(grid.theta) / np.deg2rad(73.0)
    lift = turn**2 / (1.0 + 0.25 * turn**4)
    down = q - 14.5 * smoothstep(-6.0, 29.0, q) * lift
    jaw = np.stack([width * sin, down, front + (_EAR_PLANE - front) * (1.0 - cos)], axis=-1)
    neck_width = 17.0 + 0.16 * np.maximum(grid.q - 40.0, 0.0)
    neck_front = 37.0 - 17.0 * cos + 0.12 * (grid.q - 36.0)
    neck = np.stack([neck_width * sin, grid.q - 1.0 - 8.0 * lift, neck_front], axis=-1)
    below = smoothstep(29.0, 36.0, grid.q)[..., None]
    return (1.0 - below) * jaw + below * neck


def mean_head(grid: FaceGrid) -> Float[ndarray, "rows columns 3"]:
    """The bare head with its relief and lips, without ears."""
    head = bare_head(grid)
    for height, *hill_at in _numbers()["relief"]:
        head[..., 2] += height * grid.bump(*hill_at)
    head[..., 2] += _lips(grid)
    lifted = head[..., 1] - head[:, grid.shape[1] // 2, None, 1]  # by the jaw line's rise: a mouth is level
    head[..., 1] -= 0.85 * lifted * hill(grid.q, 14.5, 5.0) * hill(grid.p, 0.0, 13.0, 4)
    return head


def _lips(grid: FaceGrid) -> ndarray:
    """What the averages blur away: the lips' fullness, the line between them and their corners, nostrils."""
    p, q = np.abs(grid.p), grid.q
    upper = 0.7 * hill(p, 0.0, 6.8, 4) * gauss(q, 12.4, 1.0)
    lower = 0.9 * hill(p, 0.0, 6.2, 4) * gauss(q, 16.0, 1.3)
    line = 1.1 * np.clip(1.0 - (p / 10.0) ** 4, 0.0, 1.0) * gauss(q, MOUTH_Q, 1.6 * MOUTH_BAND)
    return (
        -upper - lower + line + 0.5 * grid.bump(9.6, MOUTH_Q, 1.2, 1.5) + 0.6 * grid.bump(2.4, 3.1, 1.0, 0.6)
    )


def ear(grid: FaceGrid) -> Float[ndarray, "rows columns 3"]:
    """Displacement that folds an ear out of the side of the head."""
    theta, side = np.abs(grid.theta), np.sign(grid.theta)
    middle = grid.q + 5.5
    height = np.exp(-((np.abs(middle) / 7.8) ** 3.2)) * (1.0 - 0.022 * middle)
    slant = ear_slant(grid)
    rise = smoothstep(slant - 0.16, slant + 0.03, theta)
    rise = rise * (1.0 - smoothstep(slant + 0.06, slant + 0.22, theta))
    bowl = np.exp(-0.5 * (((theta - slant + 0.075) / 0.045) ** 2 + (middle / 4.0) ** 2))
    out = np.zeros((*grid.shape, 3))
    out[..., 0] = side * height * rise * 4.0 - side * bowl * 1.0
    out[..., 2] = -1.5 * height * rise
    return out


def ear_slant(grid: FaceGrid) -> Float[ndarray, "rows columns"]:
    """The angle at which the ear stands, row by row."""
    return np.deg2rad(86.0) - np.deg2rad(0.35) * (grid.q + 5.5)
