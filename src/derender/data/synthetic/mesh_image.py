"""Triangle meshes to images with exact ground truth: a fast forward-only z-buffer, for faces and cars.

Each pixel takes 3 x 3 samples (offsets -1/3, 0, 1/3); the image is their mean, the truth maps are the middle
sample alone, at the pixel's centre. Colours, normals and charts are interpolated with perspective. A face has
a colour, a part and a cosine to the light at each vertex; a car has normals, and its triangles lie on painted
surfaces (``car_paint``), so that every sample looks its colour up. Unlike ``derender.render`` this needs no
gradient. Leaves out cast shadows, speculars, and triangles seen from behind.
Numba's cache on disk refers to the named tuples by name: who renames one renames the kernels that take it.
"""

from collections.abc import Sequence
from typing import NamedTuple, no_type_check

import numpy as np
from numpy import ndarray

from derender.data.synthetic.decals import SAMPLES, Paint, paint_samples
from derender.data.synthetic.synthetic_set import FOV_DEG, Maps, camera_rotation_and_light
from derender.render.numba_threads import kernel
from derender.scene.camera import focal_px

_ALL = SAMPLES * SAMPLES
_SLIVER = np.float32(2e-6)  # area over squared sides; below, single precision cannot tell the sides apart


class TriangleMesh(NamedTuple):
    """One mesh. Corners of a triangle run clockwise in the image when seen from outside (x right, y down).

    Coloured by vertex: ``albedo`` (V,3) 0..1 and ``part`` (V,) uint8, the rest empty. Painted: ``normals``
    (V,3), inward unit vectors, ``chart`` (V,2) and ``surface`` (F,), a number into ``Paint``.
    """

    vertices: ndarray  # (V,3) float32
    triangles: ndarray  # (F,3) int32
    albedo: ndarray = np.zeros((0, 3), np.float32)
    part: ndarray = np.zeros(0, np.uint8)
    normals: ndarray = np.zeros((0, 3), np.float32)
    chart: ndarray = np.zeros((0, 2), np.float32)
    surface: ndarray = np.zeros(0, np.int32)


class ImageMaps(NamedTuple):
    """What one image is drawn into; zeros before."""

    image: ndarray  # (3,S,S) uint8
    depth: ndarray  # (S,S) float32
    normal: ndarray  # (S,S,3) float32
    albedo: ndarray  # (3,S,S) uint8
    mask: ndarray  # (S,S) bool
    parts: ndarray  # (S,S) uint8


def draw_meshes(
    meshes: Sequence[tuple[TriangleMesh, Paint]], pivot_z: float, backgrounds: Sequence[ndarray], maps: Maps
) -> None:
    """Draw one mesh an image into a batch of maps, with their camera and light, over backgrounds (S,S,3)."""
    rotation, direction = camera_rotation_and_light(maps["camera"], maps["light"])
    light = np.hstack([maps["light"][:, :2], direction]).astype(np.float32)
    rotation, pivot = rotation.astype(np.float32), np.float32(pivot_z)
    focal = np.float32(focal_px(maps["images"].shape[-1], FOV_DEG))
    fine = maps["images"].shape[-1] * SAMPLES
    nearest, owner = np.empty((fine, fine), np.float32), np.empty((fine, fine), np.int32)
    for n, ((mesh, paint), background) in enumerate(zip(meshes, backgrounds, strict=True)):
        out = ImageMaps(*(maps[name][n] for name in ("images", "depth", "normal", "albedo", "mask", "parts")))
        _draw_mesh(
            mesh,
            paint,
            pivot,
            rotation[n],
            maps["camera"][n, 3:],
            light[n],
            background,
            focal,
            nearest,
            owner,
            out,
        )


@kernel
@no_type_check
def _draw_mesh(mesh, paint, pivot_z, rotation, translation, light, background, focal_px, nearest, owner, out):
    """Fill ``out``. The mesh turns by rotation (3,3) about (0, 0, pivot_z), which comes to (0, 0, 1) +
    translation (3,); light (5,) is ambient, diffuse and the direction in the camera frame; background (S,S,3)
    0..1."""
    painted = len(mesh.chart) > 0
    # sample column, row, 1 / z, and if coloured by vertex cosine to the light and albedo: rows of 32 bytes
    points = np.empty((len(mesh.vertices), 4 if painted else 8), np.float32)
    camera = np.empty((len(mesh.vertices), 3), np.float32)
    nearest[:], owner[:] = 0.0, -1
    _place(mesh.vertices, pivot_z, rotation, translation, focal_px, len(background), camera, points)
    normals = mesh.normals if painted else np.zeros((len(mesh.vertices), 3), np.float32)
    if not painted:
        _shade_vertices(camera, mesh.triangles, mesh.albedo, light, points, normals)
    for f in range(len(mesh.triangles)):
        a, b, c = _corners(mesh.triangles, f)
        hole = -1
        if painted:
            k = mesh.surface[f]
            for h in range(paint.first_hole[k], paint.first_hole[k + 1]):
                if _meets(mesh.chart, a, b, c, paint.holes[h]):
                    hole = h
        if hole < 0:
            fill_triangle(points, a, b, c, f, nearest, owner)
        else:
            _fill_around_hole(points, mesh.chart, a, b, c, f, paint.holes[hole], nearest, owner)
    _shade_samples(mesh, paint, points, normals, owner, rotation, light, background, out)


@kernel
@no_type_check
def shift_room(vertices, rotation, half_width, room):
    """Least and greatest shifts (2,2), right and down, that keep turned vertices (V,3) in the image, which
    reaches to ``half_width`` at z = 1."""
    room[0, :], room[1, :] = -np.inf, np.inf
    for v in range(vertices.shape[0]):
        at = _turned(rotation, vertices[v, 0], vertices[v, 1], vertices[v, 2])
        reach = half_width * (at[2] + 1.0)
        for k in range(2):
            room[0, k] = max(room[0, k], -reach - at[k])
            room[1, k] = min(room[1, k], reach - at[k])


@kernel
@no_type_check
def _corners(triangles, f):
    return np.uint32(triangles[f, 0]), np.uint32(triangles[f, 1]), np.uint32(triangles[f, 2])


@kernel
@no_type_check
def _place(vertices, pivot_z, rotation, translation, focal_px, size, camera, points):
    one, samples = np.float32(1.0), np.float32(SAMPLES)
    middle = np.float32(0.5) * np.float32(size - 1)
    for v in range(np.uint32(len(vertices))):
        x, y, z = vertices[v, 0], vertices[v, 1], vertices[v, 2] - pivot_z
        across, down, away = _turned(rotation, x, y, z)
        across, down, away = across + translation[0], down + translation[1], away + translation[2] + one
        w = one / away
        camera[v, 0], camera[v, 1], camera[v, 2] = across, down, away
        points[v, 0] = samples * (focal_px * across * w + middle) + one
        points[v, 1] = samples * (focal_px * down * w + middle) + one
        points[v, 2] = w


@kernel
@no_type_check
def _shade_vertices(camera, triangles, albedo, light, points, normals):
    """Inward unit normals of a smooth mesh in the camera frame, and the cosine of each with the light."""
    for t in range(triangles.shape[0]):
        a, b, c = _corners(triangles, t)
        px, py, pz = camera[b, 0] - camera[a, 0], camera[b, 1] - camera[a, 1], camera[b, 2] - camera[a, 2]
        qx, qy, qz = camera[c, 0] - camera[a, 0], camera[c, 1] - camera[a, 1], camera[c, 2] - camera[a, 2]
        x, y, z = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
        for v in (a, b, c):
            normals[v, 0] += x
            normals[v, 1] += y
            normals[v, 2] += z
    for v in range(np.uint32(len(camera))):
        x, y, z = normals[v, 0], normals[v, 1], normals[v, 2]
        scale = np.float32(1.0) / max(np.sqrt(x * x + y * y + z * z), np.float32(1e-20))
        x, y, z = x * scale, y * scale, z * scale
        normals[v, 0], normals[v, 1], normals[v, 2] = x, y, z
        points[v, 3] = x * light[2] + y * light[3] + z * light[4]
        for k in range(3):
            points[v, 4 + k] = albedo[v, k]


@kernel
@no_type_check
def fill_triangle(points, a, b, c, number, nearest, owner):
    """Enter one triangle into ``nearest`` (1 / z, larger is nearer, 0 is empty) and ``owner`` (its number).

    It is filled row by row between its edges: where an edge crosses a row is reckoned from the edge's upper
    end, whichever triangle asks, so that neighbours leave no gap. Of two at one place the first stays.
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
def _meets(chart, a, b, c, hole):
    """Whether the triangle's bounds on its chart meet those of a circle."""
    meets = True
    for i in range(2):
        low, high = min(chart[a, i], chart[b, i], chart[c, i]), max(chart[a, i], chart[b, i], chart[c, i])
        meets = meets and low < hole[i] + hole[2] and high > hole[i] - hole[2]
    return meets


@kernel
@no_type_check
def _fill_around_hole(points, chart, a, b, c, number, hole, nearest, owner):
    """As fill_triangle, sample by sample, leaving out those whose place on the chart lies in the hole."""
    ax, ay, bx, by = points[a, 0], points[a, 1], points[b, 0], points[b, 1]
    cx, cy = points[c, 0], points[c, 1]
    if (bx - ax) * (cy - ay) <= (by - ay) * (cx - ax):
        return
    last = nearest.shape[0] - 1
    first_column = max(int(np.ceil(min(ax, bx, cx))), 0)
    last_column = min(int(np.floor(max(ax, bx, cx))), last)
    for v in range(max(int(np.ceil(min(ay, by, cy))), 0), min(int(np.floor(max(ay, by, cy))), last) + 1):
        for u in range(first_column, last_column + 1):
            wa, wb, wc = _weights(points, a, b, c, np.float32(u), np.float32(v))
            if min(wa, wb, wc) < np.float32(0.0):
                continue
            total = wa + wb + wc
            p = (wa * chart[a, 0] + wb * chart[b, 0] + wc * chart[c, 0]) / total - hole[0]
            q = (wa * chart[a, 1] + wb * chart[b, 1] + wc * chart[c, 1]) / total - hole[1]
            z = (wa / points[a, 2] + wb / points[b, 2] + wc / points[c, 2]) / total
            if z * nearest[v, u] < np.float32(1.0) and p * p + q * q >= hole[2] * hole[2]:
                nearest[v, u] = np.float32(1.0) / z
                owner[v, u] = number


@kernel
@no_type_check
def _weights(points, a, b, c, column, row):
    """Weights of a triangle's corners at a sample, with perspective, up to a common factor."""
    ax, ay = points[a, 0] - column, points[a, 1] - row
    bx, by = points[b, 0] - column, points[b, 1] - row
    cx, cy = points[c, 0] - column, points[c, 1] - row
    wa, wb, wc = bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx
    return wa * points[a, 2], wb * points[b, 2], wc * points[c, 2]


@kernel
@no_type_check
def _blend(values, k, a, b, c, wa, wb, wc):
    return wa * values[a, k] + wb * values[b, k] + wc * values[c, k]


@kernel
@no_type_check
def _shade_samples(mesh, paint, points, normals, owner, rotation, light, background, out):
    triangles, painted = mesh.triangles, len(mesh.chart) > 0
    # a painted mesh's light in the frame of its normals, so that these need not be turned
    lx = rotation[0, 0] * light[2] + rotation[1, 0] * light[3] + rotation[2, 0] * light[4]
    ly = rotation[0, 1] * light[2] + rotation[1, 1] * light[3] + rotation[2, 1] * light[4]
    lz = rotation[0, 2] * light[2] + rotation[1, 2] * light[3] + rotation[2, 2] * light[4]
    one, zero, share = np.float32(1.0), np.float32(0.0), np.float32(1.0 / _ALL)
    weight = np.empty((_ALL, 3), np.float32)  # of the corners of each sample's triangle
    spot = np.zeros((2, _ALL), np.float32)  # place on the chart
    of = np.empty(_ALL, np.int32)  # surface, -1 on the background
    inside = np.empty(_ALL, np.bool_)
    colour = np.empty((_ALL, 3), np.float32)
    part = np.empty(_ALL, np.int32)
    for i in range(np.uint32(len(background))):
        for j in range(np.uint32(len(background))):
            seen = 0
            for s in range(np.uint32(_ALL)):  # weights, place on the chart and surface of every sample
                f = owner[SAMPLES * i + s // SAMPLES, SAMPLES * j + s % SAMPLES]
                of[s] = -1
                if f < 0:
                    continue
                a, b, c = _corners(triangles, np.uint32(f))
                column, row = np.float32(SAMPLES * j + s % SAMPLES), np.float32(SAMPLES * i + s // SAMPLES)
                wa, wb, wc = _weights(points, a, b, c, column, row)
                scale = one / (wa + wb + wc)
                wa, wb, wc = wa * scale, wb * scale, wc * scale
                weight[s, 0], weight[s, 1], weight[s, 2] = wa, wb, wc
                of[s] = 0
                if painted:
                    of[s] = mesh.surface[f]
                    p = _blend(mesh.chart, 0, a, b, c, wa, wb, wc)
                    spot[0, s] = abs(p) if paint.folded[of[s]] else p
                    spot[1, s] = _blend(mesh.chart, 1, a, b, c, wa, wb, wc)
                seen += 1
            empty = np.float32(_ALL - seen)
            behind = background[i, j]
            # painted meshes are added to their background, others have it added: sums round differently
            before = empty if painted else zero
            red, green, blue = before * behind[0], before * behind[1], before * behind[2]
            current = -1
            for s in range(np.uint32(_ALL if seen else 0)):
                k = of[s]
                if k < 0:
                    continue
                f = np.uint32(owner[SAMPLES * i + s // SAMPLES, SAMPLES * j + s % SAMPLES])
                a, b, c = _corners(triangles, f)
                wa, wb, wc = weight[s, 0], weight[s, 1], weight[s, 2]
                x, y, z, scale = zero, zero, zero, one
                if painted or s == _ALL // 2:
                    x = _blend(normals, 0, a, b, c, wa, wb, wc)
                    y = _blend(normals, 1, a, b, c, wa, wb, wc)
                    z = _blend(normals, 2, a, b, c, wa, wb, wc)
                    scale = one / max(np.sqrt(x * x + y * y + z * z), np.float32(1e-20))
                if painted:
                    if k != current:
                        current = k
                        first, end = paint.first[k], paint.first[k + 1]
                        base, base_part = paint.colour[k], paint.part[k]
                        paint_samples(
                            paint.decals, first, end, base, base_part, k, spot, of, inside, colour, part
                        )
                    cosine = (x * lx + y * ly + z * lz) * scale
                else:
                    for n in range(3):
                        colour[s, n] = _blend(points, 4 + n, a, b, c, wa, wb, wc)
                    cosine = _blend(points, 3, a, b, c, wa, wb, wc)
                lit = light[0] + light[1] * max(zero, cosine)
                red += min(colour[s, 0] * lit, one)
                green += min(colour[s, 1] * lit, one)
                blue += min(colour[s, 2] * lit, one)
                if s == _ALL // 2:
                    out.mask[i, j] = True
                    out.depth[i, j] = one / _blend(points, 2, a, b, c, wa, wb, wc)
                    x, y, z = x * scale, y * scale, z * scale
                    if painted:
                        out.parts[i, j] = part[s]
                        x, y, z = _turned(rotation, x, y, z)
                    else:
                        out.parts[i, j] = mesh.part[a if wa >= max(wb, wc) else (b if wb >= wc else c)]
                    out.normal[i, j, 0], out.normal[i, j, 1], out.normal[i, j, 2] = x, y, z
                    _store(out.albedo, i, j, colour[s])
            after = zero if painted else empty
            red, green, blue = red + after * behind[0], green + after * behind[1], blue + after * behind[2]
            _store(out.image, i, j, (red * share, green * share, blue * share))


@kernel
@no_type_check
def _turned(rotation, x, y, z):
    return (
        rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z,
        rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z,
        rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z,
    )


@kernel
@no_type_check
def _store(target, i, j, colour):
    """A colour of 0..1 as rounded bytes of pixel (i, j) of ``target`` (3,S,S)."""
    zero, one, top, half = np.float32(0.0), np.float32(1.0), np.float32(255.0), np.float32(0.5)
    for n in range(3):
        target[n, i, j] = np.uint8(min(max(colour[n], zero), one) * top + half)
