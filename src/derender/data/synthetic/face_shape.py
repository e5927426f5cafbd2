"""The mean head and the shape modes that make identities: displacement fields over the face's domain.

A head is ``mean + sum of coefficient * mode``, in face pixels (see face_grid), axes as the camera's: x
right, y down, z away from the viewer, origin at the object's centre. Every mode is left-right symmetric.
Proportions follow published facial averages by eye; no scan went into them.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.interpolate import PchipInterpolator

from derender.data.synthetic.face_grid import (
    EYE_P,
    EYE_Q,
    MOUTH_BAND,
    MOUTH_Q,
    FaceGrid,
    face_grid,
    smoothstep,
)

_Q = (-51.0, -49.0, -46.0, -40.0, -31.0, -22.0, -14.0, -4.0, 6.0, 14.0, 22.0, 29.5, 34.0)
_HALF_WIDTH = (2.0, 8.5, 14.5, 21.5, 26.4, 28.2, 28.2, 27.6, 26.4, 25.2, 23.8, 21.2, 19.0)
_FRONT = (26.0, 18.0, 9.5, -1.0, -8.2, -10.0, -8.6, -8.0, -9.0, -10.0, -9.6, -9.4, -6.5)
_EAR_PLANE = 30.0  # z of the widest section


@dataclass(frozen=True)
class ShapeBasis:
    """A linear family of grids: ``mean`` (rows, columns, 3) and one displacement field per name.

    ``ear`` is kept apart because hair may cover the ears.
    """

    names: tuple[str, ...]
    mean: Float[ndarray, "rows columns 3"]
    ear: Float[ndarray, "rows columns 3"]
    modes: Float[ndarray, "modes rows columns 3"]


@lru_cache(maxsize=4)
def shape_basis(detail: float = 1.0) -> ShapeBasis:
    """Mean head and identity modes, sampled on ``face_grid(detail)``."""
    grid = face_grid(detail)
    modes = identity_modes(grid)
    fields = np.stack(list(modes.values())).astype(np.float32)
    return ShapeBasis(tuple(modes), mean_head(grid).astype(np.float32), ear(grid).astype(np.float32), fields)


def bare_head(grid: FaceGrid) -> Float[ndarray, "rows columns 3"]:
    """Skull, jaw and neck without features: elliptic sections, lifted at the sides to follow the jaw line."""
    q_face = np.minimum(grid.q, 34.0)
    width = PchipInterpolator(_Q, _HALF_WIDTH)(q_face)
    front = PchipInterpolator(_Q, _FRONT)(q_face)
    turn = np.abs(grid.theta) / np.deg2rad(73.0)
    lift = turn**2 / (1.0 + 0.25 * turn**4)
    jaw = np.stack(
        [
            width * np.sin(grid.theta),
            q_face - 14.5 * smoothstep(-6.0, 29.0, q_face) * lift,
            front + (_EAR_PLANE - front) * (1.0 - np.cos(grid.theta)),
        ],
        axis=-1,
    )
    neck_width = 17.0 + 0.16 * np.maximum(grid.q - 40.0, 0.0)
    neck = np.stack(
        [
            neck_width * np.sin(grid.theta),
            grid.q - 1.0 - 8.0 * lift,
            37.0 - 17.0 * np.cos(grid.theta) + 0.12 * (grid.q - 36.0),
        ],
        axis=-1,
    )
    below = smoothstep(29.0, 36.0, grid.q)[..., None]
    return (1.0 - below) * jaw + below * neck


def mean_head(grid: FaceGrid) -> Float[ndarray, "rows columns 3"]:
    """The bare head with brow ridge, sockets, nose, lips and chin, without ears."""
    head = bare_head(grid)
    bump = grid.bump
    head[..., 2] += (
        -1.5 * bump((9.5, -19.2), (6.5, 2.4))
        - 0.6 * bump((0.0, -18.0), (4.0, 3.0))
        + 3.0 * bump((11.0, -14.6), (5.6, 3.3))
        + 1.0 * bump((5.6, -13.0), (1.8, 3.0))
        - 2.1 * bump((EYE_P, EYE_Q + 0.2), (3.6, 2.5))
        + 0.5 * bump((11.5, -9.6), (4.5, 1.5))
        - 2.6 * bump((17.5, -4.0), (4.6, 4.6))
        - 2.2 * bump((15.5, 6.0), (6.0, 7.0))
        - 2.0 * bump((0.0, 12.5), (8.5, 6.0))
        + 0.45 * bump((0.0, 7.5), (1.0, 2.6))
        - 0.3 * bump((1.7, 7.5), (0.8, 2.8))
        + 1.5 * bump((0.0, 20.0), (5.0, 1.9))
        - 2.3 * bump((0.0, 25.5), (5.2, 3.2))
        - 1.2 * bump((18.5, 17.0), (5.0, 6.0))
        + 1.3 * bump((25.0, -20.0), (4.0, 7.0))
        + nose(grid)
        + lips(grid)
    )
    return head


def nose(grid: FaceGrid, bridge: float = 1.0) -> ndarray:
    """Depth offset of the nose: a ridge that widens to the tip, a ball, two wings, two nostrils."""
    q = grid.q
    along = np.clip((q + 16.0) / 14.0, 0.0, 1.2)
    height = (
        (2.2 + 6.2 * along**1.35) * smoothstep(-20.5, -11.5, q) * (1.0 - smoothstep(-2.2, 3.6, q)) * bridge
    )
    width = 1.7 + 1.1 * along**1.5
    ridge = height * np.exp(-0.5 * (grid.p / width) ** 2)
    foot = 1.7 * grid.bump((0.0, -3.0), (5.0, 5.0))
    ball = 2.4 * grid.bump((0.0, -1.1), (2.2, 1.9))
    wings = 3.3 * grid.bump((4.3, 0.4), (1.5, 1.5))
    nostrils = 0.8 * grid.bump((2.3, 2.3), (0.9, 0.7))
    crease = 0.6 * grid.bump((6.6, 0.6), (1.0, 2.0))
    return -ridge - foot - ball - wings + nostrils + crease


def lips(grid: FaceGrid) -> ndarray:
    """Depth offset of the lips and of the line between them."""
    p, q = np.abs(grid.p), grid.q
    across = np.exp(-((p / 7.8) ** 4))
    upper = 1.5 * across * np.exp(-0.5 * ((q - 12.3) / 1.15) ** 2)
    lower = 2.0 * np.exp(-((p / 6.6) ** 4)) * np.exp(-0.5 * ((q - 16.2) / 1.45) ** 2)
    line = (
        1.5
        * np.clip(1.0 - (p / 10.0) ** 4, 0.0, 1.0)
        * np.exp(-0.5 * ((q - MOUTH_Q) / (1.6 * MOUTH_BAND)) ** 2)
    )
    corner = 0.9 * grid.bump((9.8, MOUTH_Q), (1.3, 1.6))
    return -upper - lower + line + corner


def ear(grid: FaceGrid) -> Float[ndarray, "rows columns 3"]:
    """Displacement that folds an ear out of the side of the head."""
    theta, side = np.abs(grid.theta), np.sign(grid.theta)
    middle = grid.q + 5.5
    height = np.exp(-((np.abs(middle) / 7.8) ** 3.2)) * (1.0 - 0.022 * middle)
    slant = np.deg2rad(86.0) - np.deg2rad(0.35) * middle
    rise = smoothstep(slant - 0.16, slant + 0.03, theta) * (
        1.0 - smoothstep(slant + 0.06, slant + 0.22, theta)
    )
    bowl = np.exp(-0.5 * (((theta - slant + 0.075) / 0.045) ** 2 + (middle / 4.0) ** 2))
    out = np.zeros((*grid.shape, 3))
    out[..., 0] = side * height * rise * 4.0 - side * bowl * 1.0
    out[..., 2] = -1.5 * height * rise
    return out


def identity_modes(grid: FaceGrid) -> dict[str, Float[ndarray, "rows columns 3"]]:
    """One symmetric displacement per name; a coefficient of 1 is one standard deviation among people."""
    p, q, bump = np.abs(grid.p), grid.q, grid.bump
    side = np.sin(grid.theta)
    zero = np.zeros(grid.shape)
    upper, lower = 1.0 - smoothstep(-18.0, 2.0, q), smoothstep(2.0, 22.0, q)
    face_only = 1.0 - smoothstep(31.0, 42.0, q)

    def field(x: ndarray = zero, y: ndarray = zero, z: ndarray = zero) -> ndarray:
        return np.stack([x, y, z], axis=-1)

    eye = bump((EYE_P, EYE_Q - 1.0), (6.5, 5.5))
    nose_area = bump((0.0, -3.0), (5.5, 6.5))
    mouth = bump((0.0, MOUTH_Q), (11.0, 5.0))
    sign = np.tanh(grid.p / 3.0)
    return {
        "skull_width": field(x=1.5 * side * upper),
        "face_width": field(x=1.2 * side * bump((20.0, -2.0), (30.0, 11.0))),
        "jaw_width": field(x=1.2 * side * lower * face_only),
        "jaw_corner": field(
            x=0.7 * side * bump((26.0, 20.0), (7.0, 7.0)), y=1.0 * bump((24.0, 22.0), (8.0, 7.0))
        ),
        "face_length": field(y=1.3 * smoothstep(0.0, 28.0, q) * (1.0 - smoothstep(40.0, 56.0, q))),
        "forehead_height": field(y=-1.6 * (1.0 - smoothstep(-36.0, -20.0, q))),
        "forehead_slope": field(
            z=1.6 * (1.0 - smoothstep(-36.0, -20.0, q)) * bump((0.0, -36.0), (20.0, 30.0))
        ),
        "forehead_bulge": field(z=-0.8 * bump((7.0, -28.0), (8.0, 5.0))),
        "brow_ridge": field(z=-0.9 * bump((9.0, -18.8), (6.5, 2.3)) - 0.5 * bump((0.0, -18.0), (4.0, 2.5))),
        "brow_height": field(y=-0.75 * bump((11.0, -20.0), (8.0, 2.6))),
        "eye_distance": field(x=0.7 * sign * eye),
        "eye_depth": field(z=0.8 * bump((11.5, -14.5), (5.5, 3.4))),
        "eye_height": field(y=-0.5 * eye),
        "cheekbones": field(
            z=-1.1 * bump((17.0, -4.0), (4.4, 3.6)), x=0.8 * side * bump((21.0, -4.0), (5.0, 4.0))
        ),
        "cheek_fullness": field(
            z=-1.5 * bump((14.5, 8.0), (5.0, 6.0)), x=0.9 * side * bump((22.0, 9.0), (7.0, 7.0))
        ),
        "nose_length": field(y=0.9 * bump((0.0, 0.0), (6.0, 4.5)), z=-0.3 * nose_area),
        "nose_width": field(
            x=0.75 * sign * bump((4.5, 0.2), (3.0, 3.2)), z=-0.25 * bump((4.8, 0.6), (1.5, 1.7))
        ),
        "nose_bridge": field(
            z=-1.0 * np.exp(-0.5 * (grid.p / 2.2) ** 2) * np.exp(-0.5 * ((q + 10.0) / 4.5) ** 2)
        ),
        "nose_hump": field(z=-0.6 * bump((0.0, -8.0), (1.7, 2.4))),
        "nose_tip": field(z=-1.3 * bump((0.0, -1.2), (2.6, 2.8)), y=0.15 * bump((0.0, -1.2), (2.6, 2.8))),
        "nose_turn": field(y=-0.9 * bump((0.0, -0.2), (3.0, 2.6)), z=-0.2 * bump((0.0, 1.0), (2.5, 2.0))),
        "nose_bulb": field(
            z=-0.5 * bump((1.6, -1.3), (1.1, 1.5)), x=0.35 * sign * bump((1.8, -1.3), (1.5, 1.7))
        ),
        "philtrum": field(y=0.8 * smoothstep(4.0, 11.0, q) * bump((0.0, 13.0), (11.0, 7.0))),
        "mouth_width": field(x=0.9 * np.tanh(grid.p / 5.0) * bump((8.0, MOUTH_Q), (5.0, 4.0))),
        "mouth_forward": field(z=-0.9 * mouth),
        "upper_lip": field(y=-0.45 * bump((0.0, 11.6), (6.5, 1.3)), z=-0.35 * bump((0.0, 12.4), (6.0, 1.1))),
        "lower_lip": field(y=0.55 * bump((0.0, 17.4), (5.5, 1.6)), z=-0.45 * bump((0.0, 16.3), (5.0, 1.3))),
        "chin_forward": field(z=-1.4 * bump((0.0, 25.5), (7.0, 5.0))),
        "chin_length": field(y=1.1 * bump((0.0, 28.0), (9.0, 5.0))),
        "chin_width": field(
            x=0.9 * sign * bump((6.0, 26.0), (6.0, 5.0)), z=-0.6 * bump((6.0, 26.0), (3.0, 3.0))
        ),
        "chin_cleft": field(z=0.4 * bump((0.0, 25.5), (0.9, 2.2))),
        "neck_width": field(x=1.3 * side * smoothstep(31.0, 40.0, q)),
        "temple": field(z=0.7 * bump((22.0, -20.0), (5.0, 6.0))),
        "under_eye": field(z=0.28 * bump((10.5, -9.3), (3.8, 1.0)) - 0.22 * bump((11.0, -11.2), (3.8, 0.8))),
        "fold": field(z=_fold(p, q)),
    }


def _fold(p: ndarray, q: ndarray) -> ndarray:
    """The crease from the nose's wing to the mouth's corner."""
    along = np.clip((q - 0.5) / 11.5, 0.0, 1.0)
    centre = 6.3 + 4.6 * along**0.8
    depth = np.exp(-0.5 * ((p - centre) / 1.1) ** 2) - 0.6 * np.exp(-0.5 * ((p - centre - 2.4) / 1.8) ** 2)
    return 0.3 * depth * np.exp(-(((q - 6.5) / 6.5) ** 4))
