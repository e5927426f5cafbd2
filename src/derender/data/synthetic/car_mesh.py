"""Pieces of a car as grids, joined to one triangle mesh: grids with smooth normals, rounded boxes, wheels.

Design coordinates are metres, x right, y UP from the ground, z from the front to the rear; ``join`` turns y
down. A grid's columns and rows are ordered so that d/dcolumn x d/drow points inwards, as the conventions'
normals do. Leaves out undersides of boxes.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int32
from numpy import ndarray

from derender.data.synthetic.mesh_image import TriangleMesh
from derender.render.numba_threads import kernel

_DOWN = np.array([1.0, -1.0, 1.0])
_WHEEL_RINGS = np.array([  # distance outwards along the axle in wheel widths, radius in wheel radii
    (-0.16, 0.0), (-0.16, 0.18), (-0.2, 0.5), (-0.08, 0.66), (0.0, 0.74), (0.0, 0.88), (-0.1, 0.985),
    (-0.25, 1.0), (-0.75, 1.0), (-1.0, 0.9), (-1.0, 0.0),
])  # fmt: skip
_WHEEL_SECTORS = 24


@dataclass(frozen=True)
class Grid:
    """A piece: points (R,C,3) in metres, inward unit normals (R,C,3) in the y-down frame, chart (R,C,2),
    and its surface's number. A car has a hundred of them, so shapes are checked when they are joined."""

    points: ndarray
    normals: ndarray
    chart: ndarray
    surface: int


def smooth_grid(points: Float[ndarray, "r c 3"], chart: Float[ndarray, "r c 2"], surface: int) -> Grid:
    """A grid whose normals are area-weighted means of the cells around each vertex."""
    normals = np.zeros(points.shape)
    _add_cells(points * _DOWN, normals)
    return Grid(points, normals, chart, surface)


@kernel
@no_type_check
def _add_cells(p, normals):
    rows, columns = p.shape[0], p.shape[1]
    for r in range(rows - 1):
        for c in range(columns - 1):
            first, across, right, below = p[r, c], p[r + 1, c + 1], p[r, c + 1], p[r + 1, c]
            ax, ay, az = across[0] - first[0], across[1] - first[1], across[2] - first[2]
            bx, by, bz = below[0] - right[0], below[1] - right[1], below[2] - right[2]
            x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            for k in range(4):
                normals[r + k // 2, c + k % 2, 0] += x
                normals[r + k // 2, c + k % 2, 1] += y
                normals[r + k // 2, c + k % 2, 2] += z
    for r in range(rows):
        for c in range(columns):
            x, y, z = normals[r, c, 0], normals[r, c, 1], normals[r, c, 2]
            length = max(np.sqrt(x * x + y * y + z * z), 1e-12)
            normals[r, c, 0], normals[r, c, 1], normals[r, c, 2] = x / length, y / length, z / length


def mirrored(grid: Grid) -> Grid:
    """The piece on the other side of x = 0."""
    flip = np.array([-1.0, 1.0, 1.0])
    return Grid(grid.points[:, ::-1] * flip, grid.normals[:, ::-1] * flip, grid.chart[:, ::-1], grid.surface)


def moved(grid: Grid, by: Sequence[float]) -> Grid:
    return Grid(grid.points + np.asarray(by, float), grid.normals, grid.chart, grid.surface)


def part_of(grid: Grid, columns: slice, chart: ndarray, surface: int) -> Grid:
    """Some columns of a grid with its normals kept, so that neighbours join without a crease."""
    return Grid(grid.points[:, columns], grid.normals[:, columns], chart[:, columns], surface)


def rounded_box(
    centre: Sequence[float],
    half: Sequence[float],
    radius: float,
    surfaces: int | tuple[int, int, int, int],
    lean_rad: float = 0.0,
) -> list[Grid]:
    """A box with rounded edges and no underside; ``lean_rad`` tips its top to the rear.

    ``surfaces``: one for all faces, or those of top (chart x, z), front and rear (x, y) and sides (z, y).
    """
    sizes = np.asarray(half, float)
    core = sizes - min(radius, *half)
    rim = _box_faces()
    flat = np.where(np.abs(rim) > 0.4, np.sign(rim) * core, 0.0)
    spread = np.where(np.abs(rim) > 0.9, np.sign(rim), 0.0)
    outward = spread / np.sqrt((spread * spread).sum(axis=-1, keepdims=True))
    cos, sin = np.cos(lean_rad), np.sin(lean_rad)
    turn = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
    points = (flat + (sizes - core).min() * outward) @ turn.T + np.asarray(centre, float)
    normals = -(outward @ turn.T) * _DOWN
    top, front, rear, side = (surfaces,) * 4 if isinstance(surfaces, int) else surfaces
    faces = ((top, [0, 2]), (front, [0, 1]), (rear, [0, 1]), (side, [2, 1]), (side, [2, 1]))
    return [Grid(points[i], normals[i], points[i][..., axes], k) for i, (k, axes) in enumerate(faces)]


@lru_cache(maxsize=1)
def _box_faces() -> ndarray:
    """(5, 4, 4, 3), top, front, rear, right, left: 1 marks the rounded rim of a face, 0.5 its flat inside,
    with the sign of the side."""
    a = np.array([-1.0, -0.5, 0.5, 1.0])
    row, column = np.meshgrid(-a, a, indexing="ij")  # rows run down or forwards, columns to the right
    one = np.ones_like(row)
    faces = (
        (column, one, row),
        (column, row, -one),
        (-column, row, one),
        (one, row, column),
        (-one, row, -column),
    )
    return np.stack([np.stack(face, axis=-1) for face in faces])


def wheel(
    centre: Sequence[float], radius: float, width: float, surface: int, backwards: bool = False
) -> Grid:
    """A wheel whose outer face looks to the right (+x), or to the rear; ``centre`` is that face's middle."""
    angle = np.linspace(0.0, 2.0 * np.pi, _WHEEL_SECTORS + 1)
    out, r = _WHEEL_RINGS.T
    up, side = r[:, None] * np.cos(angle), -r[:, None] * np.sin(angle)
    axle = np.broadcast_to(out[:, None] * width, up.shape)
    shown = np.arange(len(r))[:, None] < 8
    share = np.where(shown, r[:, None], 1.2)
    chart = np.stack([share * np.cos(angle), share * np.sin(angle)], axis=-1)
    local = (-side * radius, up * radius, axle) if backwards else (axle, up * radius, side * radius)
    points = np.stack(local, axis=-1) + np.asarray(centre, float)
    grid = smooth_grid(points, chart, surface)
    seam = grid.normals[:, 0] + grid.normals[:, -1]
    length = np.maximum(np.linalg.norm(seam, axis=-1, keepdims=True), 1e-12)
    grid.normals[:, 0] = grid.normals[:, -1] = seam / length
    return grid


def wheel_house(
    inside: float,
    axle: tuple[float, float],
    radius: float,
    lowest: float,
    outside: Callable[[float, float], float],
    surface: int,
) -> Grid:
    """The hollow of a wheel arch on the right: a disc at x = ``inside`` and the wall out to the body's side.

    ``axle`` is (z, y), ``outside(z, y)`` the body's half width; nothing reaches below ``lowest``.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, _WHEEL_SECTORS + 1)
    z, y = axle[0] - radius * np.sin(angle), axle[1] + radius * np.cos(angle)
    out = np.array([outside(a, b) - 0.01 if b > lowest else inside for a, b in zip(z, y, strict=True)])
    y = np.maximum(y, lowest)
    rows = [(inside, axle[1], axle[0]), (inside, y, z), (inside, y, z), (out, y, z)]
    points = np.stack([np.stack(np.broadcast_arrays(*row, angle)[:3], axis=-1) for row in rows])
    return smooth_grid(points, points[..., [2, 1]], surface)


def join(pieces: Sequence[Grid]) -> TriangleMesh:
    """One mesh of all pieces, y down from the ground at 0."""
    starts = np.cumsum([0, *(g.points.shape[0] * g.points.shape[1] for g in pieces)])
    cells = [_cells(*g.points.shape[:2]) for g in pieces]
    return TriangleMesh(
        vertices=(np.concatenate([g.points.reshape(-1, 3) for g in pieces]) * _DOWN).astype(np.float32),
        normals=np.concatenate([g.normals.reshape(-1, 3) for g in pieces]).astype(np.float32),
        chart=np.concatenate([g.chart.reshape(-1, 2) for g in pieces]).astype(np.float32),
        triangles=np.concatenate([c + s for c, s in zip(cells, starts, strict=False)]).astype(np.int32),
        surface=np.repeat([g.surface for g in pieces], [len(c) for c in cells]).astype(np.int32),
    )


@lru_cache(maxsize=64)
def _cells(rows: int, columns: int) -> Int32[ndarray, "f 3"]:
    """The two triangles of every cell, in the columns' mirror-symmetric split."""
    r, c = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
    a, b = r * columns + c, r * columns + c + 1
    d, e = a + columns, b + columns
    right = (c >= (columns - 1) / 2)[..., None]
    first = np.where(right, np.stack([a, b, d], axis=-1), np.stack([a, b, e], axis=-1))
    second = np.where(right, np.stack([b, e, d], axis=-1), np.stack([a, e, d], axis=-1))
    return np.stack([first, second], axis=2).reshape(-1, 3).astype(np.int32)
