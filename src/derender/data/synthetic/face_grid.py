"""The parameter domain of the procedural face: rows (down the face) times columns (around the head).

A face is a grid of free 3D points. Column angle ``theta`` turns around the vertical axis of the head (0 =
the middle of the face, positive to the right of the picture); row coordinate ``q`` runs down the face.
``p`` is the sideways coordinate in which features are placed: like x near the front, the arc length further
back. Unit of ``p`` and ``q``: one pixel of a 64-pixel picture at z = 1, eyes at (+-12, -14), mouth at (0,
14), as on a mean face. Rows and columns are closer together where the face has detail. All shapes and skins
are smooth functions of this domain, so a finer grid shows the same face in more detail.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int32
from numpy import ndarray

THETA_MAX = np.deg2rad(112.0)
Q_TOP, Q_BOTTOM = -51.0, 58.0
MOUTH_Q = 14.0
MOUTH_BAND = 0.35  # half height of the closed mouth's line, which opens into the mouth's inside
EYE_P, EYE_Q = 12.2, -14.0
_HEAD_RADIUS = 26.0


@dataclass(frozen=True)
class FaceGrid:
    """Domain coordinates of every vertex: ``theta`` in radians, ``p`` and ``q`` in face pixels."""

    theta: Float[ndarray, "rows columns"]
    p: Float[ndarray, "rows columns"]
    q: Float[ndarray, "rows columns"]

    @property
    def shape(self) -> tuple[int, int]:
        return self.theta.shape

    def bump(
        self, at: tuple[float, float], size: tuple[float, float], mirrored: bool = True
    ) -> Float[ndarray, "rows columns"]:
        """A Gaussian hill of height 1 at (p, q), and its mirror image at (-p, q)."""
        p = np.abs(self.p) if mirrored else self.p
        return np.exp(-0.5 * (((p - at[0]) / size[0]) ** 2 + ((self.q - at[1]) / size[1]) ** 2))


@lru_cache(maxsize=4)
def face_grid(detail: float = 1.0) -> FaceGrid:
    """The grid with ``detail`` times the rows and columns that suit a 64-pixel picture."""
    half = _spaced(0.0, THETA_MAX, round(48 * detail) + 1, _column_density)
    theta = np.concatenate([-half[:0:-1], half])
    q = _spaced(Q_TOP, Q_BOTTOM, round(116 * detail), _row_density)
    turn = np.deg2rad(55.0)
    front = np.sin(np.minimum(half, turn))
    p_half = _HEAD_RADIUS * (front + np.cos(turn) * np.maximum(half - turn, 0.0))
    p = np.concatenate([-p_half[:0:-1], p_half])
    rows, columns = len(q), len(theta)
    shape = (rows, columns)
    return FaceGrid(
        np.broadcast_to(theta, shape).copy(),
        np.broadcast_to(p, shape).copy(),
        np.broadcast_to(q[:, None], shape).copy(),
    )


def smoothstep(low: float | ndarray, high: float | ndarray, value: ndarray) -> ndarray:
    """0 below ``low``, 1 above ``high``, a cubic with zero slope at both ends between."""
    t = np.clip((value - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _column_density(theta: ndarray) -> ndarray:
    return 1.0 + 1.6 * np.exp(-((theta / 0.62) ** 4)) + 1.2 * np.exp(-(((theta - 1.52) / 0.22) ** 2))


def _row_density(q: ndarray) -> ndarray:
    eyes = 2.6 * np.exp(-(((q + 15.5) / 5.5) ** 4))
    middle = 1.0 * np.exp(-(((q - 3.0) / 22.0) ** 4))
    mouth = 1.0 * np.exp(-(((q - MOUTH_Q) / 4.0) ** 2)) + 16.0 * np.exp(-(((q - MOUTH_Q) / 0.4) ** 4))
    return 0.6 + eyes + middle + mouth - 0.3 * smoothstep(36.0, 44.0, q)


def _spaced(low: float, high: float, count: int, density) -> ndarray:
    """``count`` increasing values from low to high, locally as close together as ``density`` says."""
    fine = np.linspace(low, high, 8001)
    mass = np.concatenate([[0.0], np.cumsum(0.5 * (density(fine)[1:] + density(fine)[:-1]))])
    return np.interp(np.linspace(0.0, mass[-1], count), mass, fine)


@lru_cache(maxsize=4)
def grid_triangles(rows: int, columns: int) -> Int32[ndarray, "f 3"]:
    """Two triangles a cell of a grid whose vertices are numbered row by row."""
    corner = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    upper, right, lower, across = corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]
    pairs = np.stack(
        [np.stack([upper, right, lower], axis=-1), np.stack([right, across, lower], axis=-1)], axis=2
    )
    return np.ascontiguousarray(pairs.reshape(-1, 3))
