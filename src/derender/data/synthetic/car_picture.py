"""Triangle meshes with painted charts to pictures with exact truth: the forward-only z-buffer of the cars.

As in mesh_picture each pixel takes 3 x 3 samples (offsets -1/3, 0, 1/3); the picture is their mean, the
truth maps are the middle sample alone. Each sample interpolates normal and chart with perspective and looks
its colour and part up in the paint table (car_decals). Leaves out cast shadows, speculars, and surfaces
seen from behind."""

from typing import no_type_check

import numpy as np

from derender.data.synthetic.car_decals import (
    BOUNDS,
    BOX,
    CHECKER,
    COLOUR,
    KIND,
    MULTIPLIES,
    PART,
    POLYGON,
    RING,
    SHAPE,
)
from derender.data.synthetic.z_buffer import SAMPLES, fill_triangle, place_samples, store_colour
from derender.render.numba_threads import kernel

_ALL = SAMPLES * SAMPLES


@kernel
@no_type_check
def draw_car(vertices, normals, chart, triangles, surface, colour, part, first, folded, decals,
             first_hole, holes, rotation, translation, light, background, size, focal_px,
             image, depth, normal, albedo, mask, parts):  # fmt: skip
    """Fill the six outputs of one picture.

    vertices (V,3) relative to the object's centre, normals (V,3) inward, chart (V,2), triangles (F,3),
    surface (F,); colour to holes as in ``PaintTable``; rotation (3,3), translation (3,), light (5,) =
    ambient, diffuse and the direction in the camera frame, background (S,S,3) 0..1; image (3,S,S) uint8,
    depth (S,S), normal (S,S,3), albedo (3,S,S) uint8, mask (S,S), parts (S,S) uint8."""
    fine = size * SAMPLES
    points = np.empty((vertices.shape[0], 4), np.float32)
    camera = np.empty((vertices.shape[0], 3), np.float32)
    nearest = np.zeros((fine, fine), np.float32)
    owner = np.full((fine, fine), -1, np.int32)
    place_samples(vertices, np.float32(0.0), rotation, translation, focal_px, size, camera, points)
    for f in range(triangles.shape[0]):
        a, b, c = np.uint32(triangles[f, 0]), np.uint32(triangles[f, 1]), np.uint32(triangles[f, 2])
        k = surface[f]
        hole = first_hole[k + 1]
        for h in range(first_hole[k], first_hole[k + 1]):
            if _meets(chart, a, b, c, holes[h]):
                hole = h
        if hole < first_hole[k + 1]:
            _fill_around_hole(points, chart, a, b, c, f, holes[hole], nearest, owner)
        else:
            fill_triangle(points, a, b, c, f, nearest, owner)
    _shade(points, normals, chart, triangles, surface, colour, part, first, folded, decals, rotation, light,
           background, owner, size, image, depth, normal, albedo, mask, parts)  # fmt: skip


@kernel
@no_type_check
def shift_room(vertices, rotation, half_width, room):
    """Least and greatest shifts (2,2), right and down, that keep turned vertices (V,3) in the picture.

    ``half_width`` is that of the picture at z = 1.
    """
    room[0, :], room[1, :] = -np.inf, np.inf
    for v in range(vertices.shape[0]):
        x, y, z = vertices[v, 0], vertices[v, 1], vertices[v, 2]
        reach = half_width * (rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + 1.0)
        for k in range(2):
            at = rotation[k, 0] * x + rotation[k, 1] * y + rotation[k, 2] * z
            room[0, k] = max(room[0, k], -reach - at)
            room[1, k] = min(room[1, k], reach - at)


@kernel
@no_type_check
def _meets(chart, a, b, c, hole):
    """Whether the triangle's bounds on its chart meet those of a circle."""
    u, v, r = hole[0], hole[1], hole[2]
    return (
        min(chart[a, 0], chart[b, 0], chart[c, 0]) < u + r
        and max(chart[a, 0], chart[b, 0], chart[c, 0]) > u - r
        and min(chart[a, 1], chart[b, 1], chart[c, 1]) < v + r
        and max(chart[a, 1], chart[b, 1], chart[c, 1]) > v - r
    )


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
            wa, wb, wc = _corners(points, a, b, c, np.float32(u), np.float32(v))
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
def _corners(points, a, b, c, column, row):
    """Weights of a triangle's corners at a sample, with perspective, up to a common factor."""
    ax, ay = points[a, 0] - column, points[a, 1] - row
    bx, by = points[b, 0] - column, points[b, 1] - row
    cx, cy = points[c, 0] - column, points[c, 1] - row
    wa, wb, wc = bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx
    return wa * points[a, 2], wb * points[b, 2], wc * points[c, 2]


@kernel
@no_type_check
def _shade(points, facing, chart, triangles, surface, base, base_part, first, folded, decals, rotation, light,
           background, owner, size, image, depth, normal, albedo, mask, parts):  # fmt: skip
    # the light in the frame of the normals, so that these need not be turned
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
    for i in range(np.uint32(size)):
        for j in range(np.uint32(size)):
            seen = _locate(points, chart, triangles, surface, folded, owner, i, j, weight, spot, of)
            empty = np.float32(_ALL - seen)
            red, green = empty * background[i, j, 0], empty * background[i, j, 1]
            blue = empty * background[i, j, 2]
            painted = -1
            for s in range(np.uint32(_ALL if seen else 0)):
                k = of[s]
                if k < 0:
                    continue
                if k != painted:
                    painted = k
                    _paint(
                        decals,
                        first[k],
                        first[k + 1],
                        base[k],
                        base_part[k],
                        spot,
                        of,
                        k,
                        inside,
                        colour,
                        part,
                    )
                f = np.uint32(owner[SAMPLES * i + s // SAMPLES, SAMPLES * j + s % SAMPLES])
                a, b, c = np.uint32(triangles[f, 0]), np.uint32(triangles[f, 1]), np.uint32(triangles[f, 2])
                wa, wb, wc = weight[s, 0], weight[s, 1], weight[s, 2]
                x = wa * facing[a, 0] + wb * facing[b, 0] + wc * facing[c, 0]
                y = wa * facing[a, 1] + wb * facing[b, 1] + wc * facing[c, 1]
                z = wa * facing[a, 2] + wb * facing[b, 2] + wc * facing[c, 2]
                scale = one / max(np.sqrt(x * x + y * y + z * z), np.float32(1e-20))
                lit = light[0] + light[1] * max(zero, (x * lx + y * ly + z * lz) * scale)
                red += min(colour[s, 0] * lit, one)
                green += min(colour[s, 1] * lit, one)
                blue += min(colour[s, 2] * lit, one)
                if s == _ALL // 2:
                    mask[i, j] = True
                    depth[i, j] = one / (wa * points[a, 2] + wb * points[b, 2] + wc * points[c, 2])
                    parts[i, j] = part[s]
                    x, y, z = x * scale, y * scale, z * scale
                    for n in range(3):
                        normal[i, j, n] = rotation[n, 0] * x + rotation[n, 1] * y + rotation[n, 2] * z
                    store_colour(albedo, i, j, colour[s, 0], colour[s, 1], colour[s, 2])
            store_colour(image, i, j, red * share, green * share, blue * share)


@kernel
@no_type_check
def _locate(points, chart, triangles, surface, folded, owner, i, j, weight, spot, of):
    """Fill in the weights, chart place and surface of a pixel's samples; how many are on the car."""
    seen = 0
    for s in range(np.uint32(_ALL)):
        v, u = SAMPLES * i + s // SAMPLES, SAMPLES * j + s % SAMPLES
        of[s] = -1
        if owner[v, u] < 0:
            continue
        f = np.uint32(owner[v, u])
        a, b, c = np.uint32(triangles[f, 0]), np.uint32(triangles[f, 1]), np.uint32(triangles[f, 2])
        wa, wb, wc = _corners(points, a, b, c, np.float32(u), np.float32(v))
        scale = np.float32(1.0) / (wa + wb + wc)
        wa, wb, wc = wa * scale, wb * scale, wc * scale
        weight[s, 0], weight[s, 1], weight[s, 2] = wa, wb, wc
        k = surface[f]
        p = wa * chart[a, 0] + wb * chart[b, 0] + wc * chart[c, 0]
        spot[0, s] = abs(p) if folded[k] else p
        spot[1, s] = wa * chart[a, 1] + wb * chart[b, 1] + wc * chart[c, 1]
        of[s] = k
        seen += 1
    return seen


@kernel
@no_type_check
def _paint(decals, first, end, base, base_part, spot, of, surface, inside, colour, part):
    """Fill in colour and part of a pixel's samples on one surface, whose shapes are ``first`` to ``end``."""
    low_p, high_p = np.float32(np.inf), -np.float32(np.inf)
    low_q, high_q = low_p, high_p
    for s in range(np.uint32(_ALL)):
        if of[s] == surface:
            low_p, high_p = min(low_p, spot[0, s]), max(high_p, spot[0, s])
            low_q, high_q = min(low_q, spot[1, s]), max(high_q, spot[1, s])
            colour[s, 0], colour[s, 1], colour[s, 2] = base[0], base[1], base[2]
            part[s] = base_part
    for d in range(np.uint32(first), np.uint32(end)):
        if (
            high_p < decals[d, BOUNDS]
            or high_q < decals[d, BOUNDS + 1]
            or low_p > decals[d, BOUNDS + 2]
            or low_q > decals[d, BOUNDS + 3]
        ):
            continue
        _cover(decals[d], spot, inside)
        red, green, blue = decals[d, COLOUR], decals[d, COLOUR + 1], decals[d, COLOUR + 2]
        multiplies, named = decals[d, MULTIPLIES] > np.float32(0.0), decals[d, PART] >= np.float32(0.0)
        for s in range(np.uint32(_ALL)):
            if inside[s] and of[s] == surface:
                if multiplies:
                    colour[s, 0], colour[s, 1], colour[s, 2] = (
                        colour[s, 0] * red,
                        colour[s, 1] * green,
                        colour[s, 2] * blue,
                    )
                else:
                    colour[s, 0], colour[s, 1], colour[s, 2] = red, green, blue
                if named:
                    part[s] = int(decals[d, PART])


@kernel
@no_type_check
def _cover(decal, spot, inside):
    """Which of a pixel's samples a shape holds."""
    u0, v0, u1, v1 = decal[BOUNDS], decal[BOUNDS + 1], decal[BOUNDS + 2], decal[BOUNDS + 3]
    kind = decal[KIND]
    if kind == POLYGON:
        inside[:] = False
        corners = np.uint32(decal[SHAPE])
        x0, y0 = decal[SHAPE + 2 * corners - 1], decal[SHAPE + 2 * corners]
        for k in range(corners):
            x, y = decal[SHAPE + 1 + 2 * k], decal[SHAPE + 2 + 2 * k]
            slope = (x0 - x) / (y0 - y) if y0 != y else np.float32(0.0)
            for s in range(np.uint32(_ALL)):
                q = spot[1, s]
                crosses = ((y > q) != (y0 > q)) & (spot[0, s] < slope * (q - y) + x)
                inside[s] = inside[s] ^ crosses
            x0, y0 = x, y
        return
    for s in range(np.uint32(_ALL)):
        p, q = spot[0, s], spot[1, s]
        inside[s] = p >= u0 and q >= v0 and p <= u1 and q <= v1
        if inside[s] and kind != BOX:
            inside[s] = _covers(decal, kind, p, q)


@kernel
@no_type_check
def _covers(decal, kind, p, q):
    """Whether a ring, spokes or a chequered field hold a point within their bounds."""
    if kind == RING:
        x, y = (p - decal[SHAPE]) / decal[SHAPE + 2], (q - decal[SHAPE + 1]) / decal[SHAPE + 3]
        away = x * x + y * y
        return away <= np.float32(1.0) and away >= decal[SHAPE + 4] * decal[SHAPE + 4]
    if kind == CHECKER:
        column = int(np.floor((p - decal[BOUNDS]) / decal[SHAPE]))
        row = int(np.floor((q - decal[BOUNDS + 1]) / decal[SHAPE + 1]))
        return (column + row) % 2 == int(decal[SHAPE + 2])
    away = np.sqrt(p * p + q * q)
    if away < decal[SHAPE + 2] or away > decal[SHAPE + 3]:
        return False
    turn = np.arctan2(q, p) / np.float32(2.0 * np.pi) * decal[SHAPE]
    return turn - np.floor(turn) < decal[SHAPE + 1]
