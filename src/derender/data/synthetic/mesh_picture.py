"""Triangle meshes to pictures with exact truth: a fast forward-only z-buffer.

Each pixel takes 3 x 3 samples (offsets -1/3, 0, 1/3); the picture is their mean, the truth maps are the
middle sample alone, at the pixel's centre. Every sample is shaded by itself: albedo and vertex normals are
interpolated with perspective. Unlike derender.render this needs no gradient, keeps a second texture-free
truth (normals, albedo, parts), and draws meshes whose points are not a depth map. Leaves out cast shadows,
speculars, and triangles seen from behind. The cosine to the light is taken at vertices and interpolated,
which in triangles of a pixel or less is the cosine of the interpolated normal.
"""

from typing import no_type_check

import numpy as np

from derender.render.numba_threads import kernel

SAMPLES = 3
_X, _Y, _W, _COSINE, _ALBEDO, _NORMAL, _ATTRIBUTES = 0, 1, 2, 3, 4, 7, 10  # columns of a vertex's row


@kernel
@no_type_check
def draw_meshes(vertices, albedo, part, triangles, rotation, translation, light, background, size, focal_px,
                image, depth, normal, albedo_map, mask, parts):  # fmt: skip
    """Fill the six outputs, one picture per row.

    vertices (N,V,3) float32 canonical points, albedo (N,V,3) 0..1, part (N,V) uint8, triangles (F,3) int32
    (a, b, c clockwise in the picture when seen from outside: x right, y down), rotation (N,3,3), translation
    (N,3), light (N,5) = ambient, diffuse and the direction in the camera frame, background (N,S,S,3) 0..1;
    image (N,3,S,S) uint8, depth (N,S,S), normal (N,S,S,3), albedo_map (N,3,S,S) uint8, mask (N,S,S), parts
    (N,S,S) uint8. A vertex shared by triangles is shaded smoothly across them; repeat it for a hard edge. A
    pixel has the part of that corner of its triangle which weighs most.
    """
    count, points = vertices.shape[0], vertices.shape[1]
    fine = size * SAMPLES
    rows = np.empty((points, _ATTRIBUTES), np.float32)
    nearest = np.empty((fine, fine), np.float32)  # 1 / z, larger is nearer, 0 is empty
    owner = np.empty((fine, fine), np.int32)
    for n in range(count):
        _place(vertices[n], albedo[n], triangles, rotation[n], translation[n], light[n], focal_px, size, rows)
        nearest[:] = 0.0
        owner[:] = -1
        for number in range(len(triangles)):
            _draw_triangle(rows, triangles[number], number, nearest, owner)
        _shade(rows, part[n], triangles, owner, light[n], background[n], size,
               image[n], depth[n], normal[n], albedo_map[n], mask[n], parts[n])  # fmt: skip


@kernel
@no_type_check
def _place(vertices, albedo, triangles, rotation, translation, light, focal_px, size, rows):
    """Each vertex's sample column, sample row, 1 / z, cosine, albedo, inward normal in the camera frame."""
    camera = np.empty((len(vertices), 3), np.float32)
    facing = np.zeros((len(vertices), 3), np.float32)
    for v in range(len(vertices)):
        x, y, z = vertices[v, 0], vertices[v, 1], vertices[v, 2] - np.float32(1.0)
        for k in range(3):
            camera[v, k] = rotation[k, 0] * x + rotation[k, 1] * y + rotation[k, 2] * z + translation[k]
        camera[v, 2] += np.float32(1.0)
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        px, py, pz = camera[b, 0] - camera[a, 0], camera[b, 1] - camera[a, 1], camera[b, 2] - camera[a, 2]
        qx, qy, qz = camera[c, 0] - camera[a, 0], camera[c, 1] - camera[a, 1], camera[c, 2] - camera[a, 2]
        x, y, z = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
        for v in (a, b, c):
            facing[v, 0] += x
            facing[v, 1] += y
            facing[v, 2] += z
    middle = np.float32(0.5 * (size - 1))
    for v in range(len(vertices)):
        w = np.float32(1.0) / camera[v, 2]
        rows[v, _X] = SAMPLES * (focal_px * camera[v, 0] * w + middle) + np.float32(1.0)
        rows[v, _Y] = SAMPLES * (focal_px * camera[v, 1] * w + middle) + np.float32(1.0)
        rows[v, _W] = w
        x, y, z = facing[v, 0], facing[v, 1], facing[v, 2]
        length = max(np.sqrt(x * x + y * y + z * z), np.float32(1e-20))
        x, y, z = x / length, y / length, z / length
        rows[v, _NORMAL], rows[v, _NORMAL + 1], rows[v, _NORMAL + 2] = x, y, z
        rows[v, _COSINE] = x * light[2] + y * light[3] + z * light[4]
        for k in range(3):
            rows[v, _ALBEDO + k] = albedo[v, k]


@kernel
@no_type_check
def _draw_triangle(rows, corners, number, nearest, owner):
    """Z-buffer one triangle; one that is seen from behind or has no area is skipped."""
    a, b, c = corners[0], corners[1], corners[2]
    ax, ay, bx, by = rows[a, _X], rows[a, _Y], rows[b, _X], rows[b, _Y]
    cx, cy = rows[c, _X], rows[c, _Y]
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    if area <= np.float32(1e-9):
        return
    fine = nearest.shape[0]
    first_column = max(int(np.ceil(min(ax, bx, cx))), 0)
    last_column = min(int(np.floor(max(ax, bx, cx))), fine - 1)
    first_row = max(int(np.ceil(min(ay, by, cy))), 0)
    last_row = min(int(np.floor(max(ay, by, cy))), fine - 1)
    if first_column > last_column or first_row > last_row:
        return
    scale = np.float32(1.0) / area
    aw, bw, cw = rows[a, _W] * scale, rows[b, _W] * scale, rows[c, _W] * scale
    for v in range(first_row, last_row + 1):
        for u in range(first_column, last_column + 1):
            wa = (bx - u) * (cy - v) - (by - v) * (cx - u)
            wb = (cx - u) * (ay - v) - (cy - v) * (ax - u)
            wc = area - wa - wb
            if wa >= 0.0 and wb >= 0.0 and wc >= 0.0:
                w = wa * aw + wb * bw + wc * cw
                if w > nearest[v, u]:
                    nearest[v, u] = w
                    owner[v, u] = number


@kernel
@no_type_check
def _shade(rows, part, triangles, owner, light, background, size,
           image, depth, normal, albedo_map, mask, parts):  # fmt: skip
    ambient, diffuse = light[0], light[1]
    one, zero = np.float32(1.0), np.float32(0.0)
    for i in range(size):
        for j in range(size):
            red, green, blue = zero, zero, zero
            for s in range(SAMPLES * SAMPLES):
                v, u = SAMPLES * i + s // SAMPLES, SAMPLES * j + s % SAMPLES
                number = owner[v, u]
                if number < 0:
                    red += background[i, j, 0]
                    green += background[i, j, 1]
                    blue += background[i, j, 2]
                    continue
                ia, ib, ic = triangles[number, 0], triangles[number, 1], triangles[number, 2]
                a, b, c = rows[ia], rows[ib], rows[ic]
                fu, fv = np.float32(u), np.float32(v)
                wa = ((b[_X] - fu) * (c[_Y] - fv) - (b[_Y] - fv) * (c[_X] - fu)) * a[_W]
                wb = ((c[_X] - fu) * (a[_Y] - fv) - (c[_Y] - fv) * (a[_X] - fu)) * b[_W]
                wc = ((a[_X] - fu) * (b[_Y] - fv) - (a[_Y] - fv) * (b[_X] - fu)) * c[_W]
                total = one / (wa + wb + wc)
                wa, wb, wc = wa * total, wb * total, wc * total
                cosine = wa * a[_COSINE] + wb * b[_COSINE] + wc * c[_COSINE]
                shading = ambient + diffuse * max(zero, cosine)
                first = wa * a[_ALBEDO] + wb * b[_ALBEDO] + wc * c[_ALBEDO]
                second = wa * a[_ALBEDO + 1] + wb * b[_ALBEDO + 1] + wc * c[_ALBEDO + 1]
                third = wa * a[_ALBEDO + 2] + wb * b[_ALBEDO + 2] + wc * c[_ALBEDO + 2]
                red += min(first * shading, one)
                green += min(second * shading, one)
                blue += min(third * shading, one)
                if s == SAMPLES * SAMPLES // 2:
                    mask[i, j] = True
                    depth[i, j] = one / (wa * a[_W] + wb * b[_W] + wc * c[_W])
                    x = wa * a[_NORMAL] + wb * b[_NORMAL] + wc * c[_NORMAL]
                    y = wa * a[_NORMAL + 1] + wb * b[_NORMAL + 1] + wc * c[_NORMAL + 1]
                    z = wa * a[_NORMAL + 2] + wb * b[_NORMAL + 2] + wc * c[_NORMAL + 2]
                    scale = one / max(np.sqrt(x * x + y * y + z * z), np.float32(1e-20))
                    normal[i, j, 0], normal[i, j, 1], normal[i, j, 2] = x * scale, y * scale, z * scale
                    _store(albedo_map, i, j, first, second, third)
                    parts[i, j] = part[ia if wa >= max(wb, wc) else (ib if wb >= wc else ic)]
            share = one / np.float32(SAMPLES * SAMPLES)
            _store(image, i, j, red * share, green * share, blue * share)


@kernel
@no_type_check
def _store(target, i, j, red, green, blue):
    """A colour of 0..1 as rounded bytes."""
    zero, one, top, half = np.float32(0.0), np.float32(1.0), np.float32(255.0), np.float32(0.5)
    target[0, i, j] = np.uint8(min(max(red, zero), one) * top + half)
    target[1, i, j] = np.uint8(min(max(green, zero), one) * top + half)
    target[2, i, j] = np.uint8(min(max(blue, zero), one) * top + half)
