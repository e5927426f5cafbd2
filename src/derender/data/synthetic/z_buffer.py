"""Which triangle is seen at each sample of a picture: the z-buffer that faces and cars share.

A pixel takes 3 x 3 samples (offsets -1/3, 0, 1/3), so a picture of S pixels has 3 S sample columns and rows.
A triangle is filled row by row between its edges: where an edge crosses a row is reckoned from the edge's
upper end, whichever triangle asks, so that neighbours leave no gap. Leaves out what is seen from behind.
Numba keeps compiled kernels by their own file alone: after a change here, touch mesh_picture and car_picture.
"""

from typing import no_type_check

import numpy as np

from derender.render.numba_threads import kernel

SAMPLES = 3
_SLIVER = np.float32(2e-6)  # area over squared sides; below, single precision cannot tell the sides apart


@kernel
@no_type_check
def place_samples(vertices, centre_z, rotation, translation, focal_px, size, camera, points):
    """Fill ``camera`` (V,3), the turned points, and ``points`` (V,3 or more): sample column, row and 1 / z.

    vertices (V,3) turn by rotation (3,3) about (0, 0, centre_z), which comes to (0, 0, 1) + translation (3,).
    """
    one, samples = np.float32(1.0), np.float32(SAMPLES)
    middle = np.float32(0.5) * np.float32(size - 1)
    for v in range(np.uint32(len(vertices))):
        x, y, z = vertices[v, 0], vertices[v, 1], vertices[v, 2] - centre_z
        across = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0]
        down = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1]
        away = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2] + one
        w = one / away
        camera[v, 0], camera[v, 1], camera[v, 2] = across, down, away
        points[v, 0] = samples * (focal_px * across * w + middle) + one
        points[v, 1] = samples * (focal_px * down * w + middle) + one
        points[v, 2] = w


@kernel
@no_type_check
def fill_triangle(points, a, b, c, number, nearest, owner):
    """Enter one triangle into ``nearest`` (1 / z, larger is nearer, 0 is empty) and ``owner`` (its number).

    a, b, c run clockwise in the picture when seen from outside. Of two at the same place the first stays.
    """
    ax, ay, bx, by = points[a, 0], points[a, 1], points[b, 0], points[b, 1]
    cx, cy = points[c, 0], points[c, 1]
    abx, aby, acx, acy = bx - ax, by - ay, cx - ax, cy - ay
    area = abx * acy - aby * acx
    if area <= _SLIVER * (abx * abx + aby * aby + acx * acx + acy * acy):
        return
    last = nearest.shape[0] - 1
    first_row = max(int(np.ceil(min(ay, by, cy))), 0)
    last_row = min(int(np.floor(max(ay, by, cy))), last)
    if first_row > last_row:
        return
    aw, bw, cw = points[a, 2], points[b, 2], points[c, 2]
    scale = np.float32(1.0) / area
    to_right = ((bw - aw) * acy - (cw - aw) * aby) * scale
    to_below = ((cw - aw) * abx - (bw - aw) * acx) * scale
    low, high = min(aw, bw, cw), max(aw, bw, cw)
    ab, bc, ca = _edge(ax, ay, bx, by), _edge(bx, by, cx, cy), _edge(cx, cy, ax, ay)
    start, end = np.float32(0.0), np.float32(last)
    for v in range(first_row, last_row + 1):
        row = np.float32(v)
        at_ab, at_bc, at_ca = _crossing(ab, row), _crossing(bc, row), _crossing(ca, row)
        left = max(at_ab if by < ay else start, at_bc if cy < by else start, at_ca if ay < cy else start)
        right = min(at_ab if by > ay else end, at_bc if cy > by else end, at_ca if ay > cy else end)
        here = aw + (row - ay) * to_below - ax * to_right
        for u in range(int(np.ceil(max(left, start))), int(np.floor(min(right, end))) + 1):
            w = min(max(here + np.float32(u) * to_right, low), high)
            if w > nearest[v, u]:
                nearest[v, u] = w
                owner[v, u] = number


@kernel
@no_type_check
def _edge(ax, ay, bx, by):
    """The upper end of an edge, and by how much the edge moves to the right in each row."""
    x, y = (ax, ay) if ay < by else (bx, by)
    return x, y, (bx - ax) / (by - ay) if ay != by else np.float32(0.0)


@kernel
@no_type_check
def _crossing(edge, row):
    return edge[0] + (row - edge[1]) * edge[2]


@kernel
@no_type_check
def store_colour(target, i, j, red, green, blue):
    """A colour of 0..1 as rounded bytes of pixel (i, j) of ``target`` (3,S,S)."""
    zero, one, top, half = np.float32(0.0), np.float32(1.0), np.float32(255.0), np.float32(0.5)
    target[0, i, j] = np.uint8(min(max(red, zero), one) * top + half)
    target[1, i, j] = np.uint8(min(max(green, zero), one) * top + half)
    target[2, i, j] = np.uint8(min(max(blue, zero), one) * top + half)
