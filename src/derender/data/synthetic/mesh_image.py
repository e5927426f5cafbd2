"""Triangle meshes to images with exact ground truth: a fast forward-only z-buffer, for faces and cars.

Each pixel takes 3 x 3 samples (offsets -1/3, 0, 1/3). The image is their mean, truth maps are the middle
sample alone, at the pixel's centre. Normals, colours and charts are interpolated with perspective. Painted
shapes (decals.py) are looked up at every sample: their edges are as sharp at 512 pixels as at 32. Unlike
``derender.render`` this needs no gradient. Leaves out what is seen from behind. Numba's cache on disk refers
to the named tuples by name: who renames one renames the kernels that take it.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int32
from numpy import ndarray

from derender.data.synthetic.decals import NO_PAINT, SAMPLES, Paint, paint_samples
from derender.data.synthetic.lighting import TEXELS, Lighting, axes_about, depths_seen, is_plain, light_at
from derender.render.numba_threads import kernel

_ALL = SAMPLES * SAMPLES
_MIDDLE = _ALL // 2
_SLIVER = np.float32(2e-6)  # area over squared sides; below, single precision cannot tell the sides apart
_ONE, _ZERO = np.float32(1.0), np.float32(0.0)


class TriangleMesh(NamedTuple):
    """One mesh about its centre of rotation. Corners of a triangle run clockwise in the image when seen from
    outside (x right, y down).

    Coloured by vertex: ``values`` (V,3) are colours 0..1, ``number`` (V,) parts; its normals follow from the
    triangles. Painted: ``values`` (V,2) are charts, ``number`` (F,) surfaces of ``paint``; ``normals`` (V,3)
    are inward unit vectors.
    """

    vertices: ndarray  # (V,3) float32
    triangles: ndarray  # (F,3) int32
    values: ndarray  # float32
    number: ndarray  # int32
    normals: ndarray = np.zeros((0, 3), np.float32)
    paint: Paint = NO_PAINT


class ImageMaps(NamedTuple):
    """What images are drawn into; zeros before."""

    image: ndarray  # (3,S,S) uint8
    depth: ndarray  # (S,S) float32
    normal: ndarray  # (S,S,3) float32
    albedo: ndarray  # (3,S,S) uint8
    mask: ndarray  # (S,S) bool
    parts: ndarray  # (S,S) uint8
    effects: ndarray  # (4,S,S) float32, as in EFFECTS; (0,S,S) where they are not kept


@lru_cache(maxsize=64)
def grid_triangles(rows: int, columns: int, mirrored: float = 0.0) -> Int32[ndarray, "f 3"]:
    """Two triangles a cell of a grid numbered row by row; columns before ``mirrored`` are split otherwise."""
    r, c = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
    a, d = r * columns + c, (r + 1) * columns + c
    left = c < mirrored
    first, second = (a, a + 1, d + left), (a + 1 - left, d + 1, d)
    return np.stack([*first, *second], axis=-1).reshape(-1, 3).astype(np.int32)


def unit(vectors: ndarray) -> ndarray:
    """The vectors along the last axis at length 1; 0 stays."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


@kernel
def draw_mesh(mesh, rotation, translation, light, background, focal_px, out):
    """Fill ``out``. The mesh is turned by rotation (3,3) and moved to (0, 0, 1) + translation (3,). Light is
    a ``Lighting``, background (S,S,3) 0..1.
    """
    painted = mesh.values.shape[1] == 2
    places = np.empty((len(mesh.vertices), 3), np.float32)  # sample column, row, 1 / z
    more = np.zeros((len(mesh.vertices), 8), np.float32)  # normal, chart or colour, cosine to the light
    _place(mesh, rotation, translation, focal_px, len(background), light, places, more)
    nearest = np.zeros((SAMPLES * len(background), SAMPLES * len(background)), np.float32)
    owner = np.full(nearest.shape, -1, np.int32)
    number = mesh.number if painted else mesh.number[:0]
    fill_triangles(places, mesh.triangles, number, more, mesh.paint.holes, nearest, owner)
    _shade_samples(mesh, places, more, owner, light, background, focal_px, nearest, out)


@kernel
def _turned(rotation, x, y, z):
    return (
        rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z,
        rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z,
        rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z,
    )


@kernel
def _corners(triangles, f):
    return np.uint32(triangles[f, 0]), np.uint32(triangles[f, 1]), np.uint32(triangles[f, 2])


@kernel
def _place(mesh, rotation, translation, focal_px, size, light, places, more):
    """Project vertices, and bring normals to the camera frame: the mesh's own, or means of its triangles'."""
    samples, middle = np.float32(SAMPLES), np.float32(0.5) * np.float32(size - 1)
    camera = np.empty((len(places), 3), np.float32)
    for v in range(np.uint32(len(places))):
        x, y, z = _turned(rotation, mesh.vertices[v, 0], mesh.vertices[v, 1], mesh.vertices[v, 2])
        x, y, z = x + translation[0], y + translation[1], z + translation[2] + _ONE
        camera[v, 0], camera[v, 1], camera[v, 2] = x, y, z
        w = _ONE / z
        places[v, 0] = samples * (focal_px * x * w + middle) + _ONE
        places[v, 1] = samples * (focal_px * y * w + middle) + _ONE
        places[v, 2] = w
        for k in range(mesh.values.shape[1]):
            more[v, 3 + k] = mesh.values[v, k]
    for v in range(np.uint32(len(mesh.normals))):
        x, y, z = _turned(rotation, mesh.normals[v, 0], mesh.normals[v, 1], mesh.normals[v, 2])
        more[v, 0], more[v, 1], more[v, 2] = x, y, z
    if len(mesh.normals):
        return
    for t in range(len(mesh.triangles)):
        a, b, c = _corners(mesh.triangles, t)
        px, py, pz = camera[b, 0] - camera[a, 0], camera[b, 1] - camera[a, 1], camera[b, 2] - camera[a, 2]
        qx, qy, qz = camera[c, 0] - camera[a, 0], camera[c, 1] - camera[a, 1], camera[c, 2] - camera[a, 2]
        x, y, z = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
        for v in (a, b, c):
            more[v, 0] += x
            more[v, 1] += y
            more[v, 2] += z
    for v in range(np.uint32(len(more))):
        x, y, z = more[v, 0], more[v, 1], more[v, 2]
        scale = _ONE / max(np.sqrt(x * x + y * y + z * z), np.float32(1e-20))
        x, y, z = x * scale, y * scale, z * scale
        more[v, 0], more[v, 1], more[v, 2] = x, y, z
        more[v, 6] = x * light.lamps[0, 1] + y * light.lamps[0, 2] + z * light.lamps[0, 3]


@kernel
def fill_triangles(places, triangles, number, more, holes, nearest, owner):
    """Enter triangles into ``nearest`` (1 / z, larger is nearer, 0 is empty) and ``owner`` (their numbers).

    Each is filled row by row between its edges: where an edge crosses a row is reckoned from the edge's upper
    end, whichever triangle asks, so that neighbours leave no gap. Of two at one place the first stays.
    Samples whose chart (``more``) lies in one of the ``holes`` of a surface (its ``number``) are left out.
    """
    last = nearest.shape[0] - 1
    start, end = _ZERO, np.float32(last)
    for f in range(np.uint32(len(triangles))):
        a, b, c = _corners(triangles, f)
        ax, ay, bx, by = places[a, 0], places[a, 1], places[b, 0], places[b, 1]
        cx, cy = places[c, 0], places[c, 1]
        abx, aby, acx, acy = bx - ax, by - ay, cx - ax, cy - ay
        area = abx * acy - aby * acx
        if area <= _SLIVER * (abx * abx + aby * aby + acx * acx + acy * acy):
            continue
        first_row = max(int(np.ceil(min(ay, by, cy))), 0)
        last_row = min(int(np.floor(max(ay, by, cy))), last)
        if first_row > last_row:
            continue
        aw, bw, cw = places[a, 2], places[b, 2], places[c, 2]
        scale = _ONE / area
        to_right = ((bw - aw) * acy - (cw - aw) * aby) * scale
        to_below = ((cw - aw) * abx - (bw - aw) * acx) * scale
        low, high = min(aw, bw, cw), max(aw, bw, cw)
        ab, bc, ca = _edge(ax, ay, bx, by), _edge(bx, by, cx, cy), _edge(cx, cy, ax, ay)
        pierced = False  # whether a hole is as far along as the triangle
        for h in range(2 if len(number) else 0):
            at, reach = holes[number[f], h, 0], holes[number[f], h, 2]
            p, q, r = more[a, 3] - at, more[b, 3] - at, more[c, 3] - at
            pierced = pierced or (reach > _ZERO and min(p, q, r) < reach and max(p, q, r) > -reach)
        for v in range(first_row, last_row + 1):
            row = np.float32(v)
            at_ab, at_bc, at_ca = _crossing(ab, row), _crossing(bc, row), _crossing(ca, row)
            left = max(at_ab if by < ay else start, at_bc if cy < by else start, at_ca if ay < cy else start)
            right = min(at_ab if by > ay else end, at_bc if cy > by else end, at_ca if ay > cy else end)
            here = aw + (row - ay) * to_below - ax * to_right
            for u in range(int(np.ceil(max(left, start))), int(np.floor(min(right, end))) + 1):
                w = min(max(here + np.float32(u) * to_right, low), high)
                if w > nearest[v, u]:
                    if pierced and _in_hole(places, more, a, b, c, u, v, holes, number[f]):
                        continue
                    nearest[v, u] = w
                    owner[v, u] = f


@kernel
def _edge(ax, ay, bx, by):
    """The upper end of an edge, and by how much the edge moves to the right in each row."""
    x, y = (ax, ay) if ay < by else (bx, by)
    return x, y, (bx - ax) / (by - ay) if ay != by else _ZERO


@kernel
def _crossing(edge, row):
    return edge[0] + (row - edge[1]) * edge[2]


@kernel
def _in_hole(places, more, a, b, c, u, v, holes, k):
    wa, wb, wc = _weights(places, a, b, c, np.float32(u), np.float32(v))
    inside = False
    for h in range(2):
        x = wa * more[a, 3] + wb * more[b, 3] + wc * more[c, 3] - holes[k, h, 0]
        y = wa * more[a, 4] + wb * more[b, 4] + wc * more[c, 4] - holes[k, h, 1]
        inside = inside or x * x + y * y < holes[k, h, 2] * holes[k, h, 2]
    return inside


@kernel
def _weights(places, a, b, c, column, row):
    """Weights of a triangle's corners at a sample, with perspective."""
    ax, ay = places[a, 0] - column, places[a, 1] - row
    bx, by = places[b, 0] - column, places[b, 1] - row
    cx, cy = places[c, 0] - column, places[c, 1] - row
    wa = (bx * cy - by * cx) * places[a, 2]
    wb = (cx * ay - cy * ax) * places[b, 2]
    wc = (ax * by - ay * bx) * places[c, 2]
    scale = _ONE / (wa + wb + wc)
    return wa * scale, wb * scale, wc * scale


@kernel
def _blend(more, k, a, b, c, wa, wb, wc):
    return wa * more[a, k] + wb * more[b, k] + wc * more[c, k]


@kernel
def _shade_samples(mesh, places, more, owner, light, background, focal_px, nearest, out):
    painted, share, scale = mesh.values.shape[1] == 2, np.float32(1.0 / _ALL), _ONE
    weight = np.empty((_ALL, 3), np.float32)  # of the corners of each sample's triangle
    surface = np.empty(_ALL, np.int32)  # of each sample, -1 on the background
    spot = np.zeros((2, _ALL), np.float32)  # place on the chart
    inside = np.empty(_ALL, np.bool_)
    colour = np.empty((_ALL, 3), np.float32)
    part = np.empty(_ALL, np.int32)
    plain, lamp, result, air = is_plain(light), light.lamps[0], np.ones(4, np.float32), light.haze[1]
    result[2] = _ZERO
    span, veil = depths_seen(nearest), np.exp(-light.haze[0])  # of what is farthest, and of the background
    for i in range(np.uint32(len(background))):
        for j in range(np.uint32(len(background))):
            seen = 0
            for s in range(np.uint32(_ALL)):
                u, v = SAMPLES * j + s % SAMPLES, SAMPLES * i + s // SAMPLES
                f = owner[v, u]
                surface[s] = -1
                if f < 0:
                    continue
                seen += 1
                a, b, c = _corners(mesh.triangles, np.uint32(f))
                wa, wb, wc = _weights(places, a, b, c, np.float32(u), np.float32(v))
                weight[s, 0], weight[s, 1], weight[s, 2] = wa, wb, wc
                surface[s] = 0
                if painted:
                    surface[s] = mesh.number[f]
                    p = _blend(more, 3, a, b, c, wa, wb, wc)
                    spot[0, s] = abs(p) if mesh.paint.folded[surface[s]] else p
                    spot[1, s] = _blend(more, 4, a, b, c, wa, wb, wc)
            if painted and seen:
                paint_samples(mesh.paint, surface, spot, inside, colour, part)
            empty, behind = np.float32(_ALL - seen), background[i, j]
            if light.haze[0] > _ZERO:
                behind = behind * veil + air * (_ONE - veil)
            red, green, blue = empty * behind[0], empty * behind[1], empty * behind[2]
            for s in range(np.uint32(_ALL if seen else 0)):
                if surface[s] < 0:
                    continue
                f = np.uint32(owner[SAMPLES * i + s // SAMPLES, SAMPLES * j + s % SAMPLES])
                a, b, c = _corners(mesh.triangles, f)
                wa, wb, wc = weight[s, 0], weight[s, 1], weight[s, 2]
                x, y, z = _ZERO, _ZERO, _ZERO
                if painted or s == _MIDDLE or not plain:
                    x = _blend(more, 0, a, b, c, wa, wb, wc)
                    y = _blend(more, 1, a, b, c, wa, wb, wc)
                    z = _blend(more, 2, a, b, c, wa, wb, wc)
                    scale = _ONE / max(np.sqrt(x * x + y * y + z * z), np.float32(1e-20))
                if painted:
                    cosine = (x * lamp[1] + y * lamp[2] + z * lamp[3]) * scale
                else:
                    cosine = _blend(more, 6, a, b, c, wa, wb, wc)
                    for n in range(3):
                        colour[s, n] = _blend(more, 3 + n, a, b, c, wa, wb, wc)
                result[0] = light.ambient + lamp[0] * max(_ZERO, cosine)
                if not plain:
                    u = np.float32(j + (s % SAMPLES - 1) / SAMPLES)
                    v = np.float32(i + (s // SAMPLES - 1) / SAMPLES)
                    place = u, v, _ONE / _blend(places, 2, a, b, c, wa, wb, wc), focal_px, len(background)
                    light_at(light, place, (x * scale, y * scale, z * scale), span, result)
                lit, shine, passed, veiled = result[0], result[2], result[3], air * (_ONE - result[3])
                red += min((colour[s, 0] * lit + shine) * passed + veiled, _ONE)
                green += min((colour[s, 1] * lit + shine) * passed + veiled, _ONE)
                blue += min((colour[s, 2] * lit + shine) * passed + veiled, _ONE)
                if s == _MIDDLE:
                    if not painted:
                        part[s] = mesh.number[a if wa >= max(wb, wc) else (b if wb >= wc else c)]
                    out.mask[i, j], out.parts[i, j] = True, part[s]
                    out.depth[i, j] = _ONE / _blend(places, 2, a, b, c, wa, wb, wc)
                    out.normal[i, j, 0], out.normal[i, j, 1] = x * scale, y * scale
                    out.normal[i, j, 2] = z * scale
                    _store(out.albedo, i, j, colour[s])
                    if len(out.effects):
                        out.effects[:, i, j] = result
            _store(out.image, i, j, (red * share, green * share, blue * share))


@kernel
def _store(target, i, j, colour):
    """A colour of 0..1 as rounded bytes of pixel (i, j) of ``target`` (3,S,S)."""
    for n in range(3):
        target[n, i, j] = np.uint8(min(max(colour[n], _ZERO), _ONE) * np.float32(255.0) + np.float32(0.5))


def lit_by(
    mesh: TriangleMesh, rotation: Float32[ndarray, "3 3"], translation: Float32[ndarray, "3"],
    ambient: float, lamps: Float32[ndarray, "lamps 4"], gloss: Float32[ndarray, "2"],
    haze: Float32[ndarray, "2"], shadows: bool, image_size: int,
) -> Lighting:  # fmt: skip
    """The light of one image of a mesh; ``lamps`` as in ``Lighting``.

    Shadow maps, if requested, tell how near to a lamp the nearest surface is, seen along its light.
    """
    centre = (translation + np.array([0, 0, 1], np.float32)).astype(np.float32)
    none = np.zeros((0, 0, 0), np.float32)
    across = np.zeros((len(lamps), 2, 3), np.float32)
    lighting = Lighting(np.float32(ambient), lamps, gloss, haze, across, centre, none)
    if not shadows:
        return lighting
    points = mesh.vertices @ rotation.T
    size = TEXELS * image_size
    scale = 0.48 * size / max(float(np.linalg.norm(points, axis=1).max()), 1e-6)
    maps = np.zeros((len(lamps), size, size), np.float32)
    for number, lamp in enumerate(lamps):
        across[number] = scale * axes_about(lamp[1:].astype(float))
        places = np.empty((len(points), 3), np.float32)
        places[:, :2] = points @ across[number].T + 0.5 * (size - 1)
        places[:, 2] = 1 - points @ lamp[1:]
        more, holes = np.zeros((len(points), 8), np.float32), np.zeros((0, 2, 3), np.float32)
        owner = np.empty(maps[number].shape, np.int32)
        fill_triangles(places, mesh.triangles, mesh.number[:0], more, holes, maps[number], owner)
    return lighting._replace(maps=maps)
