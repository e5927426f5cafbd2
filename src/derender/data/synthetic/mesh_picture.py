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

from derender.data.synthetic.z_buffer import SAMPLES, fill_triangle, place_samples, store_colour
from derender.render.numba_threads import kernel

_X, _Y, _W, _COSINE, _ALBEDO, _ATTRIBUTES = 0, 1, 2, 3, 4, 8  # columns of a vertex's row, 32 bytes


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
    facing = np.empty((points, 3), np.float32)
    camera = np.empty((points, 3), np.float32)
    nearest = np.empty((fine, fine), np.float32)
    owner = np.empty((fine, fine), np.int32)
    for n in range(count):
        place_samples(vertices[n], np.float32(1.0), rotation[n], translation[n], focal_px, size, camera, rows)
        _attributes(camera, albedo[n], triangles, light[n], rows, facing)
        nearest[:] = 0.0
        owner[:] = -1
        for f in range(triangles.shape[0]):
            a, b, c = np.uint32(triangles[f, 0]), np.uint32(triangles[f, 1]), np.uint32(triangles[f, 2])
            fill_triangle(rows, a, b, c, f, nearest, owner)
        _shade(rows, facing, part[n], triangles, owner, light[n], background[n], size,
               image[n], depth[n], normal[n], albedo_map[n], mask[n], parts[n])  # fmt: skip


@kernel
@no_type_check
def _attributes(camera, albedo, triangles, light, rows, facing):
    """Each vertex's cosine and albedo, and its inward unit normal in the camera frame."""
    facing[:] = 0.0
    for t in range(triangles.shape[0]):
        a, b, c = np.uint32(triangles[t, 0]), np.uint32(triangles[t, 1]), np.uint32(triangles[t, 2])
        px, py, pz = camera[b, 0] - camera[a, 0], camera[b, 1] - camera[a, 1], camera[b, 2] - camera[a, 2]
        qx, qy, qz = camera[c, 0] - camera[a, 0], camera[c, 1] - camera[a, 1], camera[c, 2] - camera[a, 2]
        x, y, z = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
        for v in (a, b, c):
            facing[v, 0] += x
            facing[v, 1] += y
            facing[v, 2] += z
    for v in range(np.uint32(camera.shape[0])):
        x, y, z = facing[v, 0], facing[v, 1], facing[v, 2]
        scale = np.float32(1.0) / max(np.sqrt(x * x + y * y + z * z), np.float32(1e-20))
        x, y, z = x * scale, y * scale, z * scale
        facing[v, 0], facing[v, 1], facing[v, 2] = x, y, z
        rows[v, _COSINE] = x * light[2] + y * light[3] + z * light[4]
        for k in range(3):
            rows[v, _ALBEDO + k] = albedo[v, k]


@kernel
@no_type_check
def _shade(rows, facing, part, triangles, owner, light, background, size,
           image, depth, normal, albedo_map, mask, parts):  # fmt: skip
    ambient, diffuse = light[0], light[1]
    one, zero, share = np.float32(1.0), np.float32(0.0), np.float32(1.0 / SAMPLES**2)
    for i in range(np.uint32(size)):
        for j in range(np.uint32(size)):
            red, green, blue, empty = zero, zero, zero, zero
            for s in range(np.uint32(SAMPLES * SAMPLES)):
                v, u = SAMPLES * i + s // SAMPLES, SAMPLES * j + s % SAMPLES
                if owner[v, u] < 0:
                    empty += one
                    continue
                f = np.uint32(owner[v, u])
                a, b, c = np.uint32(triangles[f, 0]), np.uint32(triangles[f, 1]), np.uint32(triangles[f, 2])
                column, row = np.float32(u), np.float32(v)
                ax, ay = rows[a, _X] - column, rows[a, _Y] - row
                bx, by = rows[b, _X] - column, rows[b, _Y] - row
                cx, cy = rows[c, _X] - column, rows[c, _Y] - row
                wa, wb, wc = bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx
                wa, wb, wc = wa * rows[a, _W], wb * rows[b, _W], wc * rows[c, _W]
                scale = one / (wa + wb + wc)
                wa, wb, wc = wa * scale, wb * scale, wc * scale
                cosine = wa * rows[a, _COSINE] + wb * rows[b, _COSINE] + wc * rows[c, _COSINE]
                shading = ambient + diffuse * max(zero, cosine)
                k = np.uint32(_ALBEDO)
                first = wa * rows[a, k] + wb * rows[b, k] + wc * rows[c, k]
                second = wa * rows[a, k + 1] + wb * rows[b, k + 1] + wc * rows[c, k + 1]
                third = wa * rows[a, k + 2] + wb * rows[b, k + 2] + wc * rows[c, k + 2]
                red += min(first * shading, one)
                green += min(second * shading, one)
                blue += min(third * shading, one)
                if s == SAMPLES * SAMPLES // 2:
                    mask[i, j] = True
                    depth[i, j] = one / (wa * rows[a, _W] + wb * rows[b, _W] + wc * rows[c, _W])
                    x = wa * facing[a, 0] + wb * facing[b, 0] + wc * facing[c, 0]
                    y = wa * facing[a, 1] + wb * facing[b, 1] + wc * facing[c, 1]
                    z = wa * facing[a, 2] + wb * facing[b, 2] + wc * facing[c, 2]
                    scale = one / max(np.sqrt(x * x + y * y + z * z), np.float32(1e-20))
                    normal[i, j, 0], normal[i, j, 1], normal[i, j, 2] = x * scale, y * scale, z * scale
                    store_colour(albedo_map, i, j, first, second, third)
                    parts[i, j] = part[a if wa >= max(wb, wc) else (b if wb >= wc else c)]
            red += empty * background[i, j, 0]
            green += empty * background[i, j, 1]
            blue += empty * background[i, j, 2]
            store_colour(image, i, j, red * share, green * share, blue * share)
