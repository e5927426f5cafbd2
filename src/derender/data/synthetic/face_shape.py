"""The mean head, and the linear family of heads around it: mean + sum of coefficient * mode.

In face pixels (see face_grid), axes as the camera's: x right, y down, z away from the viewer, origin at the
object's centre. The mean is symmetric and smooth: elliptic sections plus hills, whose heights, places and
widths were fitted by least squares to the average neutral surface of renders of a published morphable model
(ICT-FaceKit, MIT licence; 0.2 face pixels rms). Leaves out the back of the head. Modes are in face_modes.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.interpolate import PchipInterpolator

from derender.data.synthetic.face_grid import MOUTH_BAND, MOUTH_Q, FaceGrid, face_grid, smoothstep
from derender.data.synthetic.face_modes import identity_modes

_Q = (-51.0, -49.0, -46.0, -40.0, -31.0, -22.0, -14.0, -4.0, 6.0, 14.0, 22.0, 29.5, 34.0)
_HALF_WIDTH = (2.0, 11.0, 17.5, 24.0, 28.0, 28.6, 28.9, 28.0, 26.7, 26.1, 24.8, 21.4, 18.5)
_FRONT = (25.0, 14.5, 7.0, -1.2, -7.6, -9.5, -7.6, -7.1, -9.7, -9.2, -9.2, -5.4, -5.2)
_EAR_PLANE = 30.0  # z of the widest section
# brow, sockets, cheeks, nose, mouth, chin as hills: height (z), place (p, q), widths
_RELIEF = (
    (-2.78, 13.38, -19.78, 9.95, 3.45), (1.76, 0.04, -21.71, 3.54, 5.57), (4.28, 10.18, -17.07, 4.23, 3.77),
    (1.71, 4.5, -13.4, 2.21, 3.55), (-2.79, 11.76, -14.16, 2.33, 2.8), (1.28, 13.01, -12.15, 6.56, 3.17),
    (-5.37, 21.62, -4.02, 4.05, 5.68), (-2.57, 17.77, 6.42, 7.56, 5.17), (-1.58, 0, 12.21, 7.83, 4.73),
    (0.5, 0, 6.37, 1.37, 1.61), (-0.75, 1.32, 8.95, 2.76, 2.97), (2.12, 2.82, 20.98, 8.13, 2.22),
    (-1.25, 0, 25.98, 5.45, 3.24), (-3.11, 23.74, 17.03, 5.79, 11.77), (0.85, 24.71, -18.78, 3.23, 4.86),
    (-1.91, 1.25, -13.3, 1.58, 2.75), (-3.82, 0.47, -9.43, 2.83, 2.76), (-4.63, 1.14, -4.6, 2.92, 2.85),
    (-4.29, 1.19, -1.6, 4.03, 2.44), (-1.39, -0.72, -2.8, 4.12, 4.51), (-3.39, -0.35, 1.35, 1.78, 1.51),
    (-3.84, 4.76, 0.44, 1.57, 1.88), (1.85, 3.83, 2.02, 1.02, 1.09), (2.73, 6.37, -0.32, 2.56, 5.27),
    (1.25, 3.1, 12.6, 3.4, 0.7), (0.82, 0, 11.9, 3.46, 0.98), (-0.79, 0.96, 14.35, 4.84, 2.08),
    (1.69, 9.69, 15.59, 2.54, 2.58), (1.08, 5.9, -27.81, 9.31, 6.2), (-2.11, 21.12, -14.58, 5.16, 8.15),
    (2.83, 12.4, 6.61, 4.63, 4.2), (2.41, 17.14, 28.14, 4.53, 7.73), (1.62, 19.53, -8.05, 2.32, 5.77),
    (-0.59, 6.64, 8.68, 2.57, 2.62), (1.57, 4.78, -14.85, 5.28, 5.54), (1.39, 19.44, 12.45, 2.7, 9.33),
)  # fmt: skip


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
    """The bare head with its relief and lips, without ears."""
    head = bare_head(grid)
    for height, p, q, wide, high in _RELIEF:
        head[..., 2] += height * grid.bump((p, q), (wide, high))
    head[..., 2] += lips(grid)
    lifted = head[..., 1] - head[:, grid.shape[1] // 2, None, 1]  # by the jaw line's rise: a mouth is level
    head[..., 1] -= 0.85 * lifted * np.exp(-(((grid.q - 14.5) / 5.0) ** 2)) * np.exp(-((grid.p / 13.0) ** 4))
    return head


def lips(grid: FaceGrid) -> ndarray:
    """What the averages blur away: the lips' fullness, the line between them and their corners, nostrils."""
    p, q = np.abs(grid.p), grid.q
    upper = 0.7 * np.exp(-((p / 6.8) ** 4)) * np.exp(-0.5 * ((q - 12.4) / 1.0) ** 2)
    lower = 0.9 * np.exp(-((p / 6.2) ** 4)) * np.exp(-0.5 * ((q - 16.0) / 1.3) ** 2)
    line = (
        1.1
        * np.clip(1.0 - (p / 10.0) ** 4, 0.0, 1.0)
        * np.exp(-0.5 * ((q - MOUTH_Q) / (1.6 * MOUTH_BAND)) ** 2)
    )
    corner = 0.5 * grid.bump((9.6, MOUTH_Q), (1.2, 1.5))
    nostrils = 0.6 * grid.bump((2.4, 3.1), (1.0, 0.6))
    return -upper - lower + line + corner + nostrils


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
