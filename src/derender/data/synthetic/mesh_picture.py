"""Grid meshes of free 3D points to pictures with exact truth: a fast forward-only z-buffer.

Each pixel takes 3 x 3 samples (offsets -1/3, 0, 1/3); the picture is their mean, the truth maps are the
middle sample alone, at the pixel's centre. Every sample is shaded by itself: albedo and vertex normals are
interpolated with perspective. Unlike derender.render this needs no gradient, shades a second texture-free
truth (normals, albedo), and draws meshes whose points are not a depth map. Leaves out cast shadows,
speculars, and surfaces seen from behind.
"""

from typing import no_type_check

import numpy as np

from derender.render.numba_threads import kernel

SAMPLES = 3


@kernel
@no_type_check
def draw_meshes(vertices, albedo, rotation, translation, light, background, size, focal_px,
                image, depth, normal, albedo_map, mask):  # fmt: skip
    """Fill the five outputs, one picture per row.

    vertices (N,R,C,3) canonical points, albedo (N,R,C,3) 0..1, rotation (N,3,3), translation (N,3), light
    (N,5) = ambient, diffuse and the direction in the camera frame, background (N,S,S,3) 0..1; image
    (N,3,S,S) uint8, depth (N,S,S), normal (N,S,S,3), albedo_map (N,3,S,S) uint8, mask (N,S,S).
    """
    count, rows, columns = vertices.shape[0], vertices.shape[1], vertices.shape[2]
    fine = size * SAMPLES
    for n in range(count):
        point = np.empty((rows, columns, 3), np.float32)  # sample column, sample row, 1 / z
        camera = np.empty((rows, columns, 3), np.float32)
        facing = np.empty((rows, columns, 3), np.float32)
        _to_camera(vertices[n], rotation[n], translation[n], camera)
        _vertex_normals(camera, facing)
        middle = 0.5 * (size - 1)
        for r in range(rows):
            for c in range(columns):
                z = camera[r, c, 2]
                point[r, c, 0] = SAMPLES * (focal_px * camera[r, c, 0] / z + middle) + 1.0
                point[r, c, 1] = SAMPLES * (focal_px * camera[r, c, 1] / z + middle) + 1.0
                point[r, c, 2] = 1.0 / z
        nearest = np.zeros((fine, fine), np.float32)  # 1 / z, larger is nearer, 0 is empty
        owner = np.full((fine, fine), -1, np.int32)
        for r in range(rows - 1):
            for c in range(columns - 1):
                cell = (r * (columns - 1) + c) * 2
                _draw_triangle(point, r, c, r, c + 1, r + 1, c, cell, nearest, owner)
                _draw_triangle(point, r, c + 1, r + 1, c + 1, r + 1, c, cell + 1, nearest, owner)
        _shade(point, facing, albedo[n], owner, light[n], background[n], size, columns,
               image[n], depth[n], normal[n], albedo_map[n], mask[n])  # fmt: skip


@kernel
@no_type_check
def _to_camera(vertices, rotation, translation, camera):
    for r in range(vertices.shape[0]):
        for c in range(vertices.shape[1]):
            x, y, z = vertices[r, c, 0], vertices[r, c, 1], vertices[r, c, 2] - np.float32(1.0)
            for k in range(3):
                camera[r, c, k] = (
                    rotation[k, 0] * x + rotation[k, 1] * y + rotation[k, 2] * z + translation[k]
                )
            camera[r, c, 2] += np.float32(1.0)


@kernel
@no_type_check
def _vertex_normals(points, normal):
    """Inward unit normals by central differences along rows and columns (d/dcolumn x d/drow)."""
    rows, columns = points.shape[0], points.shape[1]
    for r in range(rows):
        up, down = max(r - 1, 0), min(r + 1, rows - 1)
        for c in range(columns):
            left, right = max(c - 1, 0), min(c + 1, columns - 1)
            ax = points[r, right, 0] - points[r, left, 0]
            ay = points[r, right, 1] - points[r, left, 1]
            az = points[r, right, 2] - points[r, left, 2]
            bx = points[down, c, 0] - points[up, c, 0]
            by = points[down, c, 1] - points[up, c, 1]
            bz = points[down, c, 2] - points[up, c, 2]
            x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            length = max(np.sqrt(x * x + y * y + z * z), np.float32(1e-20))
            normal[r, c, 0], normal[r, c, 1], normal[r, c, 2] = x / length, y / length, z / length


@kernel
@no_type_check
def _draw_triangle(point, ra, ca, rb, cb, rc, cc, number, nearest, owner):
    """Z-buffer one triangle; one that is seen from behind or has no area is skipped."""
    ax, ay, aw = point[ra, ca, 0], point[ra, ca, 1], point[ra, ca, 2]
    bx, by, bw = point[rb, cb, 0], point[rb, cb, 1], point[rb, cb, 2]
    cx, cy, cw = point[rc, cc, 0], point[rc, cc, 1], point[rc, cc, 2]
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
                    nearest[v, u] = w
                    owner[v, u] = number


@kernel
@no_type_check
def _shade(point, facing, albedo, owner, light, background, size, columns,
           image, depth, normal, albedo_map, mask):  # fmt: skip
    ambient, diffuse = light[0], light[1]
    colour = np.empty(3, np.float32)
    weight = np.empty(4, np.float32)
    total = np.empty(3, np.float32)
    for i in range(size):
        for j in range(size):
            total[:] = 0.0
            for s in range(SAMPLES * SAMPLES):
                v, u = SAMPLES * i + s // SAMPLES, SAMPLES * j + s % SAMPLES
                number = owner[v, u]
                if number < 0:
                    for k in range(3):
                        total[k] += background[i, j, k]
                    continue
                r, c = number // 2 // (columns - 1), number // 2 % (columns - 1)
                ra, ca, rb, cb, rc, cc = r, c + number % 2, r + number % 2, c + 1, r + 1, c
                _weights(point, ra, ca, rb, cb, rc, cc, u, v, weight)
                wa, wb, wc = weight[0], weight[1], weight[2]
                x = wa * facing[ra, ca, 0] + wb * facing[rb, cb, 0] + wc * facing[rc, cc, 0]
                y = wa * facing[ra, ca, 1] + wb * facing[rb, cb, 1] + wc * facing[rc, cc, 1]
                z = wa * facing[ra, ca, 2] + wb * facing[rb, cb, 2] + wc * facing[rc, cc, 2]
                length = max(np.sqrt(x * x + y * y + z * z), np.float32(1e-20))
                x, y, z = x / length, y / length, z / length
                shading = ambient + diffuse * max(np.float32(0.0), x * light[2] + y * light[3] + z * light[4])
                for k in range(3):
                    colour[k] = wa * albedo[ra, ca, k] + wb * albedo[rb, cb, k] + wc * albedo[rc, cc, k]
                    total[k] += min(max(colour[k] * shading, np.float32(0.0)), np.float32(1.0))
                if s == SAMPLES * SAMPLES // 2:
                    mask[i, j] = True
                    depth[i, j] = weight[3]
                    normal[i, j, 0], normal[i, j, 1], normal[i, j, 2] = x, y, z
                    for k in range(3):
                        albedo_map[k, i, j] = np.uint8(colour[k] * np.float32(255.0) + np.float32(0.5))
            for k in range(3):
                mean = total[k] / np.float32(SAMPLES * SAMPLES)
                image[k, i, j] = np.uint8(mean * np.float32(255.0) + np.float32(0.5))


@kernel
@no_type_check
def _weights(point, ra, ca, rb, cb, rc, cc, u, v, weight):
    """Perspective-correct weights of a triangle's corners at sample (u, v), and z there."""
    ax, ay, bx, by = point[ra, ca, 0], point[ra, ca, 1], point[rb, cb, 0], point[rb, cb, 1]
    cx, cy = point[rc, cc, 0], point[rc, cc, 1]
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    wa = ((bx - u) * (cy - v) - (by - v) * (cx - u)) / area * point[ra, ca, 2]
    wb = ((cx - u) * (ay - v) - (cy - v) * (ax - u)) / area * point[rb, cb, 2]
    wc = ((ax - u) * (by - v) - (ay - v) * (bx - u)) / area * point[rc, cc, 2]
    z = np.float32(1.0) / (wa + wb + wc)
    weight[0], weight[1], weight[2], weight[3] = wa * z, wb * z, wc * z, z
