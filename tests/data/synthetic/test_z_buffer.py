"""The shared z-buffer against its definition: the nearest triangle at each sample, no gaps between them."""

import numpy as np
import pytest

from derender.data.synthetic.mesh_image import fill_triangles

SIZE = 48


def filled(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    nearest = np.zeros((SIZE, SIZE), np.float32)
    owner = np.full((SIZE, SIZE), -1, np.int32)
    none = np.zeros(0, np.int32), np.zeros((0, 8), np.float32), np.zeros((1, 2, 3), np.float32)
    fill_triangles(points.astype(np.float32), triangles.astype(np.int32), *none, nearest, owner)
    return nearest, owner


def defined(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """In double precision, sample by sample."""
    p = points.astype(np.float32).astype(np.float64)
    row, column = np.mgrid[:SIZE, :SIZE].astype(float)
    nearest, owner = np.zeros((SIZE, SIZE)), np.full((SIZE, SIZE), -1)
    for number, corners in enumerate(triangles):
        (ax, ay, _), (bx, by, _), (cx, cy, _) = a, b, c = p[corners]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area <= 0:
            continue
        wa = (bx - column) * (cy - row) - (by - row) * (cx - column)
        wb = (cx - column) * (ay - row) - (cy - row) * (ax - column)
        wc = area - wa - wb
        w = (wa * a[2] + wb * b[2] + wc * c[2]) / area
        seen = (np.minimum(wa, np.minimum(wb, wc)) >= 0) & (w > nearest)
        nearest[seen], owner[seen] = w[seen], number
    return nearest, owner


def test_random_triangles_are_those_of_the_definition():
    generator = np.random.default_rng(0)
    points = np.column_stack([generator.uniform(-9, SIZE + 9, (150, 2)), generator.uniform(0.8, 1.2, 150)])
    triangles = generator.permutation(150).reshape(50, 3)
    nearest, owner = filled(points, triangles)
    expected, expected_owner = defined(points, triangles)
    assert (owner == expected_owner).mean() > 0.999  # single precision may differ on an edge
    same = owner == expected_owner
    assert np.abs(nearest - expected)[same].max() < 1e-5


@pytest.mark.parametrize("cells", [3, 40, 150])
def test_a_sheet_of_triangles_has_no_gap(cells):
    """From cells of sixteen samples to cells of a third of one, shaken, with corners exactly on samples."""
    generator = np.random.default_rng(cells)
    at = np.linspace(-2.0, SIZE + 2.0, cells + 1)
    x, y = np.meshgrid(at, at)
    shake = 0.3 * (at[1] - at[0]) * generator.uniform(-1, 1, (2, *x.shape))
    shake[:, [0, -1]] = shake[:, :, [0, -1]] = 0.0
    snap = (generator.random(x.shape) < 0.2) & (cells < 50)  # smaller cells would fold
    x, y = (np.where(snap, np.round(v + s), v + s) for v, s in zip((x, y), shake, strict=True))
    points = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    corner = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, :-1], corner[1:, 1:]
    triangles = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (b, d, c))])
    _, owner = filled(points, triangles)
    assert (owner >= 0).all()
