"""Triangle meshes with painted charts to pictures with exact truth: the forward-only z-buffer of the cars.

As in mesh_picture each pixel takes 3 x 3 samples (offsets -1/3, 0, 1/3); the picture is their mean, the
truth maps are the middle sample alone. Each sample interpolates normal and chart with perspective and looks
its colour and part up in the paint table (car_decals). Leaves out cast shadows, speculars, and surfaces
seen from behind."""

from typing import no_type_check

import numpy as np

from derender.data.synthetic.car_decals import (
    BOUNDS,
    CHECKER,
    COLOUR,
    KIND,
    MULTIPLIES,
    PART,
    POLYGON,
    RING,
    SHAPE,
)
from derender.render.numba_threads import kernel

SAMPLES = 3


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
    count = vertices.shape[0]
    point = np.empty((count, 3), np.float32)  # sample column, sample row, 1 / z
    middle = np.float32(0.5) * (size - 1)
    one, samples = np.float32(1.0), np.float32(SAMPLES)
    for v in range(count):
        x, y, z = vertices[v, 0], vertices[v, 1], vertices[v, 2]
        w = one / (rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2] + one)
        u = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0]
        t = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1]
        point[v, 0] = samples * (focal_px * u * w + middle) + one
        point[v, 1] = samples * (focal_px * t * w + middle) + one
        point[v, 2] = w
    fine = size * SAMPLES
    nearest = np.zeros((fine, fine), np.float32)  # 1 / z, larger is nearer, 0 is empty
    owner = np.full((fine, fine), -1, np.int32)
    for f in range(triangles.shape[0]):
        a, b, c = triangles[f, 0], triangles[f, 1], triangles[f, 2]
        k = surface[f]
        hole = first_hole[k + 1]
        for h in range(first_hole[k], first_hole[k + 1]):
            if _meets(chart, a, b, c, holes[h]):
                hole = h
        _draw_triangle(point, chart, a, b, c, f, holes, hole, hole < first_hole[k + 1], nearest, owner)
    _shade(point, normals, chart, triangles, surface, colour, part, first, folded, decals, rotation, light,
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
def _draw_triangle(point, chart, a, b, c, number, holes, hole, has_hole, nearest, owner):
    """Z-buffer one triangle; one that is seen from behind or has no area is skipped, samples in a hole
    too."""
    ax, ay, aw = point[a, 0], point[a, 1], point[a, 2]
    bx, by, bw = point[b, 0], point[b, 1], point[b, 2]
    cx, cy, cw = point[c, 0], point[c, 1], point[c, 2]
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    if area <= np.float32(1e-9):
        return
    fine = nearest.shape[0]
    first_column = max(int(np.ceil(min(ax, bx, cx))), 0)
    last_column = min(int(np.floor(max(ax, bx, cx))), fine - 1)
    first_row = max(int(np.ceil(min(ay, by, cy))), 0)
    last_row = min(int(np.floor(max(ay, by, cy))), fine - 1)
    scale = np.float32(1.0) / area
    for v in range(first_row, last_row + 1):
        for u in range(first_column, last_column + 1):
            wa = (bx - u) * (cy - v) - (by - v) * (cx - u)
            wb = (cx - u) * (ay - v) - (cy - v) * (ax - u)
            wc = area - wa - wb
            if wa >= 0.0 and wb >= 0.0 and wc >= 0.0:
                w = (wa * aw + wb * bw + wc * cw) * scale
                if w > nearest[v, u]:
                    if has_hole:
                        pa, pb, pc = wa * aw / w * scale, wb * bw / w * scale, wc * cw / w * scale
                        p = pa * chart[a, 0] + pb * chart[b, 0] + pc * chart[c, 0] - holes[hole, 0]
                        q = pa * chart[a, 1] + pb * chart[b, 1] + pc * chart[c, 1] - holes[hole, 1]
                        if p * p + q * q < holes[hole, 2] * holes[hole, 2]:
                            continue
                    nearest[v, u] = w
                    owner[v, u] = number


@kernel
@no_type_check
def _shade(point, facing, chart, triangles, surface, base, base_part, first, folded, decals, rotation, light,
           background, owner, size, image, depth, normal, albedo, mask, parts):  # fmt: skip
    # the light in the frame of the normals, so that these need not be turned
    lx = rotation[0, 0] * light[2] + rotation[1, 0] * light[3] + rotation[2, 0] * light[4]
    ly = rotation[0, 1] * light[2] + rotation[1, 1] * light[3] + rotation[2, 1] * light[4]
    lz = rotation[0, 2] * light[2] + rotation[1, 2] * light[3] + rotation[2, 2] * light[4]
    white, half, share = np.float32(255.0), np.float32(0.5), np.float32(1.0 / SAMPLES**2)
    weight = np.empty((SAMPLES * SAMPLES, 4), np.float32)  # of the triangle's corners; z
    spot = np.empty((SAMPLES * SAMPLES, 2), np.float32)  # place on the chart
    near = np.empty(decals.shape[0], np.int32)  # the shapes that may lie in this pixel
    colour = np.empty(3, np.float32)
    unit = np.empty(3, np.float32)
    for i in range(size):
        for j in range(size):
            only = _locate(point, chart, triangles, surface, folded, owner, i, j, weight, spot)
            count = _candidates(decals, first, spot, only, near) if only >= 0 else 0
            red, green, blue = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for s in range(SAMPLES * SAMPLES):
                f = owner[SAMPLES * i + s // SAMPLES, SAMPLES * j + s % SAMPLES]
                if f < 0:
                    red += background[i, j, 0]
                    green += background[i, j, 1]
                    blue += background[i, j, 2]
                    continue
                a, b, c = triangles[f, 0], triangles[f, 1], triangles[f, 2]
                wa, wb, wc = weight[s, 0], weight[s, 1], weight[s, 2]
                x = wa * facing[a, 0] + wb * facing[b, 0] + wc * facing[c, 0]
                y = wa * facing[a, 1] + wb * facing[b, 1] + wc * facing[c, 1]
                z = wa * facing[a, 2] + wb * facing[b, 2] + wc * facing[c, 2]
                scale = np.float32(1.0) / max(np.sqrt(x * x + y * y + z * z), np.float32(1e-20))
                lit = light[0] + light[1] * max(np.float32(0.0), (x * lx + y * ly + z * lz) * scale)
                k = surface[f]
                if only < 0:
                    count = first[k + 1] - first[k]
                    for d in range(count):
                        near[d] = first[k] + d
                seen = _paint(decals, near, count, spot[s, 0], spot[s, 1], base[k], base_part[k], colour)
                red += min(colour[0] * lit, np.float32(1.0))
                green += min(colour[1] * lit, np.float32(1.0))
                blue += min(colour[2] * lit, np.float32(1.0))
                if s == SAMPLES * SAMPLES // 2:
                    mask[i, j] = True
                    depth[i, j] = weight[s, 3]
                    parts[i, j] = seen
                    unit[0], unit[1], unit[2] = x * scale, y * scale, z * scale
                    for n in range(3):
                        normal[i, j, n] = (
                            rotation[n, 0] * unit[0] + rotation[n, 1] * unit[1] + rotation[n, 2] * unit[2]
                        )
                        albedo[n, i, j] = np.uint8(colour[n] * white + half)
            image[0, i, j] = np.uint8(red * share * white + half)
            image[1, i, j] = np.uint8(green * share * white + half)
            image[2, i, j] = np.uint8(blue * share * white + half)


@kernel
@no_type_check
def _locate(point, chart, triangles, surface, folded, owner, i, j, weight, spot):
    """Perspective-correct weights and chart place of a pixel's samples; its surface if it is one, else -1."""
    only = -2
    for s in range(SAMPLES * SAMPLES):
        v, u = SAMPLES * i + s // SAMPLES, SAMPLES * j + s % SAMPLES
        f = owner[v, u]
        if f < 0:
            only = -1
            continue
        a, b, c = triangles[f, 0], triangles[f, 1], triangles[f, 2]
        ax, ay, bx, by = point[a, 0], point[a, 1], point[b, 0], point[b, 1]
        cx, cy = point[c, 0], point[c, 1]
        wa = ((bx - u) * (cy - v) - (by - v) * (cx - u)) * point[a, 2]
        wb = ((cx - u) * (ay - v) - (cy - v) * (ax - u)) * point[b, 2]
        wc = ((ax - u) * (by - v) - (ay - v) * (bx - u)) * point[c, 2]
        scale = np.float32(1.0) / (wa + wb + wc)
        wa, wb, wc = wa * scale, wb * scale, wc * scale
        weight[s, 0], weight[s, 1], weight[s, 2] = wa, wb, wc
        weight[s, 3] = ((bx - ax) * (cy - ay) - (by - ay) * (cx - ax)) * scale
        k = surface[f]
        p = wa * chart[a, 0] + wb * chart[b, 0] + wc * chart[c, 0]
        spot[s, 0] = abs(p) if folded[k] else p
        spot[s, 1] = wa * chart[a, 1] + wb * chart[b, 1] + wc * chart[c, 1]
        if only == -2:
            only = k
        elif only != k:
            only = -1
    return only if only >= 0 else -1


@kernel
@no_type_check
def _candidates(decals, first, spot, surface, near):
    """Fill ``near`` with the shapes of a surface whose bounds meet those of a pixel's samples; how many."""
    low_p, high_p = spot[0, 0], spot[0, 0]
    low_q, high_q = spot[0, 1], spot[0, 1]
    for s in range(1, SAMPLES * SAMPLES):
        low_p, high_p = min(low_p, spot[s, 0]), max(high_p, spot[s, 0])
        low_q, high_q = min(low_q, spot[s, 1]), max(high_q, spot[s, 1])
    count = 0
    for d in range(first[surface], first[surface + 1]):
        if (
            high_p >= decals[d, BOUNDS]
            and high_q >= decals[d, BOUNDS + 1]
            and low_p <= decals[d, BOUNDS + 2]
            and low_q <= decals[d, BOUNDS + 3]
        ):
            near[count] = d
            count += 1
    return count


@kernel
@no_type_check
def _paint(decals, near, count, p, q, base, part, colour):
    """Colour at a place of a chart, and the part it belongs to."""
    colour[0], colour[1], colour[2] = base[0], base[1], base[2]
    for n in range(count):
        d = near[n]
        if _covers(decals, d, p, q):
            if decals[d, PART] >= np.float32(0.0):
                part = int(decals[d, PART])
            for k in range(3):
                over = decals[d, COLOUR + k]
                colour[k] = colour[k] * over if decals[d, MULTIPLIES] > np.float32(0.0) else over
    return part


@kernel
@no_type_check
def _covers(decals, d, p, q):
    """Whether shape d holds the point (p, q) of its chart."""
    if (
        p < decals[d, BOUNDS]
        or q < decals[d, BOUNDS + 1]
        or p > decals[d, BOUNDS + 2]
        or q > decals[d, BOUNDS + 3]
    ):
        return False
    kind = decals[d, KIND]
    if kind == POLYGON:
        inside = False
        corners = int(decals[d, SHAPE])
        before = corners - 1
        for k in range(corners):
            x, y = decals[d, SHAPE + 1 + 2 * k], decals[d, SHAPE + 2 + 2 * k]
            x0, y0 = decals[d, SHAPE + 1 + 2 * before], decals[d, SHAPE + 2 + 2 * before]
            if (y > q) != (y0 > q) and p < (x0 - x) * (q - y) / (y0 - y) + x:
                inside = not inside
            before = k
        return inside
    if kind == RING:
        x = (p - decals[d, SHAPE]) / decals[d, SHAPE + 2]
        y = (q - decals[d, SHAPE + 1]) / decals[d, SHAPE + 3]
        away = x * x + y * y
        return away <= np.float32(1.0) and away >= decals[d, SHAPE + 4] * decals[d, SHAPE + 4]
    if kind == CHECKER:
        column = int(np.floor((p - decals[d, BOUNDS]) / decals[d, SHAPE]))
        row = int(np.floor((q - decals[d, BOUNDS + 1]) / decals[d, SHAPE + 1]))
        return (column + row) % 2 == int(decals[d, SHAPE + 2])
    away = np.sqrt(p * p + q * q)
    if away < decals[d, SHAPE + 2] or away > decals[d, SHAPE + 3]:
        return False
    turn = np.arctan2(q, p) / np.float32(2.0 * np.pi) * decals[d, SHAPE]
    return turn - np.floor(turn) < decals[d, SHAPE + 1]
