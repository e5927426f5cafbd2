"""Triangle meshes to images with exact ground truth: a fast forward-only z-buffer, for faces and cars.

Each pixel takes 3 x 3 samples (offsets -1/3, 0, 1/3). The image is their mean, truth maps are the middle
sample alone, at the pixel's centre. Normals, colours and charts are interpolated with perspective. Painted
shapes (decals.py) are looked up at every sample: their edges are as sharp at 512 pixels as at 32. Unlike
``derender.render`` this needs no gradient. Leaves out what is seen from behind. Renaming tuples: decals.py.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int32
from numpy import ndarray

from derender.data.synthetic.decals import NO_PAINT, SAMPLES, Paint, paint_samples
from derender.data.synthetic.lighting import Lighting, light_at
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


def draw_mesh(
    mesh: TriangleMesh, rotation: Float32[ndarray, "3 3"], translation: Float32[ndarray, "3"],
    light: Lighting, background: Float32[ndarray, "s s 3"], focal_px: np.float32, out: ImageMaps,
) -> None:  # fmt: skip
    """Fill ``out`` with the mesh, turned and moved to (0, 0, 1) + ``translation``, before a background of
    0..1; and the light's shadow maps."""
    if len(light.maps):
        _cast_shadows(mesh, rotation, translation, light)
    places, more = _place(mesh, rotation, translation, focal_px, len(background), light)
    nearest = np.zeros((SAMPLES * len(background), SAMPLES * len(background)), np.float32)
    owner = np.full(nearest.shape, -1, np.int32)
    number = mesh.number if mesh.values.shape[1] == 2 else mesh.number[:0]
    fill_triangles(places, mesh.triangles, number, more, mesh.paint.holes, nearest, owner)
    span = (_ONE, _ONE)  # least and greatest depth that are seen, for haze
    if light.haze[0] > _ZERO and (seen := nearest[nearest > _ZERO]).size:
        span = (_ONE / seen.max(), _ONE / seen.min())
    _shade_samples(mesh, places, more, owner, light, background, focal_px, span, out)


def _place(
    mesh: TriangleMesh, rotation: ndarray, translation: ndarray, focal_px: np.float32, size: int,
    light: Lighting,
) -> tuple[Float32[ndarray, "v 3"], Float32[ndarray, "v 8"]]:  # fmt: skip
    """Column and row of a sample, 1 / z; and normal, chart or colour, cosine to the light; by vertex."""
    camera = _turned(mesh.vertices, rotation) + translation
    camera[:, 2] += _ONE
    w = _ONE / camera[:, 2]
    middle = np.float32(0.5) * np.float32(size - 1)
    across = np.float32(SAMPLES) * (focal_px * camera[:, :2] * w[:, None] + middle) + _ONE
    more = np.zeros((len(camera), 8), np.float32)
    more[:, 3 : 3 + mesh.values.shape[1]] = mesh.values
    if len(mesh.normals):
        more[:, :3] = _turned(mesh.normals, rotation)
    else:
        a, b, c = camera[mesh.triangles.T]
        _add_at_corners(mesh.triangles, np.cross(b - a, c - a), more)
        x, y, z = more[:, :3].T
        more[:, :3] *= (_ONE / np.maximum(np.sqrt(x * x + y * y + z * z), np.float32(1e-20)))[:, None]
        more[:, 6] = x * light.lamps[0, 1] + y * light.lamps[0, 2] + z * light.lamps[0, 3]
    return np.column_stack([across, w]), more


def _turned(points: Float32[ndarray, "n 3"], rotation: Float32[ndarray, "3 3"]) -> Float32[ndarray, "n 3"]:
    """Points turned, in single precision and the same on every machine, as a matrix product is not."""
    x, y, z = points.T[..., None]
    return rotation[:, 0] * x + rotation[:, 1] * y + rotation[:, 2] * z


@kernel
def _add_at_corners(triangles, vectors, sums):
    for f in range(len(triangles)):
        for corner in _corners(triangles, f):
            for n in range(3):
                sums[corner, n] += vectors[f, n]


@kernel
def _corners(triangles, f):
    return np.uint32(triangles[f, 0]), np.uint32(triangles[f, 1]), np.uint32(triangles[f, 2])


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
        pierced = len(number) > 0 and holes[number[f], 0, 2] > _ZERO  # whether its surface has holes
        for v in range(first_row, last_row + 1):
            row = np.float32(v)
            at_ab, at_bc, at_ca = _crossing(ab, row), _crossing(bc, row), _crossing(ca, row)
            left = max(at_ab if by < ay else start, at_bc if cy < by else start, at_ca if ay < cy else start)
            right = min(at_ab if by > ay else end, at_bc if cy > by else end, at_ca if ay > cy else end)
            here = aw + (row - ay) * to_below - ax * to_right
            for u in range(int(np.ceil(max(left, start))), int(np.floor(min(right, end))) + 1):
                w = min(max(here + np.float32(u) * to_right, low), high)
                if w > nearest[v, u]:
                    if pierced:
                        at = _seen_at(places, triangles, f, np.float32(u), np.float32(v))
                        if _in_hole(more, at, holes, number[f]):
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
def _in_hole(more, at, holes, k):
    inside = False
    for h in range(2):
        x = _blend(more, 3, at) - holes[k, h, 0]
        y = _blend(more, 4, at) - holes[k, h, 1]
        inside = inside or x * x + y * y < holes[k, h, 2] * holes[k, h, 2]
    return inside


@kernel
def _seen_at(places, triangles, f, column, row):
    """The corners of a triangle, and their weights at a sample, with perspective."""
    a, b, c = _corners(triangles, f)
    ax, ay = places[a, 0] - column, places[a, 1] - row
    bx, by = places[b, 0] - column, places[b, 1] - row
    cx, cy = places[c, 0] - column, places[c, 1] - row
    wa = (bx * cy - by * cx) * places[a, 2]
    wb = (cx * ay - cy * ax) * places[b, 2]
    wc = (ax * by - ay * bx) * places[c, 2]
    scale = _ONE / (wa + wb + wc)
    return a, b, c, wa * scale, wb * scale, wc * scale


@kernel
def _blend(more, k, at):
    return at[3] * more[at[0], k] + at[4] * more[at[1], k] + at[5] * more[at[2], k]


@kernel
def _blend_three(more, k, at):
    return _blend(more, k, at), _blend(more, k + 1, at), _blend(more, k + 2, at)


@kernel
def _shade_samples(mesh, places, more, owner, light, background, focal_px, span, out):
    painted, side = mesh.values.shape[1] == 2, len(background)
    surface = np.empty(_ALL, np.int32)  # of each sample, -1 on the background
    spot = np.zeros((2, _ALL), np.float32)  # place on the chart
    inside = np.empty(_ALL, np.bool_)
    colour = np.empty((_ALL, 3), np.float32)
    part, total = np.empty(_ALL, np.int32), np.empty(3, np.float32)
    plain = len(light.lamps) == 1 and len(light.maps) == 0
    plain = plain and light.gloss[0] == _ZERO and light.haze[0] == _ZERO
    lamp, result, air = light.lamps[0], np.ones(4, np.float32), light.haze[1]
    result[2] = _ZERO
    depth, cosine, normal = _ONE, _ZERO, (_ZERO, _ZERO, _ZERO)
    veil = np.exp(-light.haze[0])  # of what is farthest, and of the background
    for pixel in range(np.uint32(side * side)):
        i, j, seen = pixel // side, pixel % side, 0
        for s in range(np.uint32(_ALL)):
            u, v = SAMPLES * j + s % SAMPLES, SAMPLES * i + s // SAMPLES
            f = owner[v, u]
            surface[s] = -1
            if f < 0:
                continue
            seen += 1
            surface[s] = 0
            if painted:
                at = _seen_at(places, mesh.triangles, np.uint32(f), np.float32(u), np.float32(v))
                surface[s] = mesh.number[f]
                spot[0, s], spot[1, s] = _blend(more, 3, at), _blend(more, 4, at)
        if painted and seen:
            paint_samples(mesh.paint, surface, spot, inside, colour, part)
        for n in range(3):
            behind = background[i, j, n] * veil + air * (_ONE - veil)
            total[n] = np.float32(_ALL - seen) * behind
        for s in range(np.uint32(_ALL if seen else 0)):
            if surface[s] < 0:
                continue
            u, v = SAMPLES * j + s % SAMPLES, SAMPLES * i + s // SAMPLES
            at = _seen_at(places, mesh.triangles, np.uint32(owner[v, u]), np.float32(u), np.float32(v))
            if painted or s == _MIDDLE or not plain:
                x, y, z = _blend_three(more, 0, at)
                scale = _ONE / max(np.sqrt(x * x + y * y + z * z), np.float32(1e-20))
                cosine = (x * lamp[1] + y * lamp[2] + z * lamp[3]) * scale
                normal = (x * scale, y * scale, z * scale)
                depth = _ONE / _blend(places, 2, at)
            if not painted:
                cosine = _blend(more, 6, at)
                colour[s, 0], colour[s, 1], colour[s, 2] = _blend_three(more, 3, at)
            result[0] = light.ambient + lamp[0] * max(_ZERO, cosine)
            if not plain:
                column, row = np.float32((u - 1) / SAMPLES), np.float32((v - 1) / SAMPLES)
                light_at(light, (column, row, depth, focal_px, side), normal, span, result)
            for n in range(3):
                lit = (colour[s, n] * result[0] + result[2]) * result[3] + air * (_ONE - result[3])
                total[n] += min(lit, _ONE)
            if s == _MIDDLE:
                if not painted:
                    most = max(at[3], at[4], at[5])
                    part[s] = mesh.number[at[0] if at[3] == most else at[1] if at[4] == most else at[2]]
                out.mask[i, j], out.parts[i, j], out.depth[i, j] = True, part[s], depth
                out.normal[i, j, 0], out.normal[i, j, 1], out.normal[i, j, 2] = normal
                _store(out.albedo, i, j, colour[s])
                if len(out.effects):
                    out.effects[:, i, j] = result
        _store(out.image, i, j, total * np.float32(1.0 / _ALL))


@kernel
def _store(target, i, j, colour):
    """A colour of 0..1 as rounded bytes of pixel (i, j) of ``target`` (3,S,S)."""
    for n in range(3):
        target[n, i, j] = np.uint8(min(max(colour[n], _ZERO), _ONE) * np.float32(255.0) + np.float32(0.5))


def _cast_shadows(mesh: TriangleMesh, rotation: ndarray, translation: ndarray, light: Lighting) -> None:
    """Fill in the shadow maps: how near to each lamp the nearest surface is, seen along its light."""
    points, size = mesh.vertices @ rotation.T, light.maps.shape[-1]
    scale = 0.48 * size / max(float(np.linalg.norm(points, axis=1).max()), 1e-6)
    light.centre[:] = translation + np.array([0, 0, 1], np.float32)
    more, holes = np.zeros((len(points), 8), np.float32), np.zeros((0, 2, 3), np.float32)
    for lamp, across, nearest in zip(light.lamps, light.across, light.maps, strict=True):
        direction = lamp[1:].astype(float)
        first = unit(np.cross((0.0, 1.0, 0.0) if abs(direction[1]) < 0.9 else (1.0, 0.0, 0.0), direction))
        across[:] = scale * np.stack([first, np.cross(direction, first)])
        places = np.column_stack([points @ across.T + 0.5 * (size - 1), 1 - points @ lamp[1:]])
        owner = np.empty(nearest.shape, np.int32)
        fill_triangles(places, mesh.triangles, mesh.number[:0], more, holes, nearest, owner)
