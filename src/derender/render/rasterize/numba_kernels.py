"""The rasteriser's inner loops for Numba; importing this module imports Numba.

``choose`` walks each image's triangles in order with a z-buffer (``choose_in`` for one image, which warping
uses too), ``intersect`` meets each pixel's ray with its triangle, ``intersect_backward`` is the derivative of
that meeting, by hand. Arithmetic is float64 in the order of operations of ``reference.py``, so that both
decide alike.
"""

from math import ceil, floor
from typing import no_type_check

import numpy as np

from derender.render.numba_threads import kernel
from derender.render.rasterize.rule import (
    EDGE_TOLERANCE,
    MAX_COORDINATE_PX,
    MIN_TWICE_AREA_PX2,
    NEAR_Z,
    TIE_TOLERANCE,
)

REACH = 3 * EDGE_TOLERANCE
TIED = 1 - TIE_TOLERANCE


@kernel
@no_type_check
def project(points, focal, screen):
    """Write where points (H, W, 3) land in the picture and their inverse depth, 0 for one left out."""
    height, width = points.shape[0], points.shape[1]
    centre_u, centre_v = (width - 1) / 2, (height - 1) / 2
    for i in range(height):
        for j in range(width):
            z = np.float64(points[i, j, 2])
            inverse_z = 1 / z
            u = np.float64(points[i, j, 0]) * inverse_z * focal + centre_u
            v = np.float64(points[i, j, 1]) * inverse_z * focal + centre_v
            seen = z > NEAR_Z and abs(u) <= MAX_COORDINATE_PX and abs(v) <= MAX_COORDINATE_PX
            screen[0, i, j] = u
            screen[1, i, j] = v
            screen[2, i, j] = inverse_z if seen else 0.0


@kernel
@no_type_check
def choose_in(screen, nearest, held, triangle):
    """Write the visible triangle of each pixel of one image, or -1; ``nearest`` and ``held`` are scratch."""
    us, vs, inverse_zs = screen[0], screen[1], screen[2]
    height, width = us.shape
    nearest[:] = 0
    held[:] = 0
    triangle[:] = -1
    # A second walk is needed only where a candidate given up on the way turns out to be tied in the end.
    for walk in range(2):
        forgotten = False
        for i in range(height - 1):
            for j in range(width - 1):
                for half in range(2):
                    i0, j0, i1, j1 = i, j + half, i + half, j + 1
                    i2, j2 = i + 1, j
                    a0, a1, a2 = inverse_zs[i0, j0], inverse_zs[i1, j1], inverse_zs[i2, j2]
                    if a0 == 0 or a1 == 0 or a2 == 0:
                        continue
                    u0, u1, u2 = us[i0, j0], us[i1, j1], us[i2, j2]
                    v0, v1, v2 = vs[i0, j0], vs[i1, j1], vs[i2, j2]
                    area = (u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0)
                    if not abs(area) > MIN_TWICE_AREA_PX2:
                        continue
                    low, high = min(u0, u1, u2), max(u0, u1, u2)
                    margin = REACH * (high - low)
                    first_u = ceil(max(low - margin, 0.0))
                    last_u = floor(min(high + margin, width - 1.0))
                    low, high = min(v0, v1, v2), max(v0, v1, v2)
                    margin = REACH * (high - low)
                    first_v = ceil(max(low - margin, 0.0))
                    last_v = floor(min(high + margin, height - 1.0))
                    scale = 1 / area
                    for q in range(first_v, last_v + 1):
                        for p in range(first_u, last_u + 1):
                            du0, du1, du2 = u0 - p, u1 - p, u2 - p
                            dv0, dv1, dv2 = v0 - q, v1 - q, v2 - q
                            weight0 = (du1 * dv2 - du2 * dv1) * scale
                            weight1 = (du2 * dv0 - du0 * dv2) * scale
                            weight2 = (du0 * dv1 - du1 * dv0) * scale
                            if min(weight0, weight1, weight2) < -EDGE_TOLERANCE:
                                continue
                            inverse_depth = weight0 * a0 + weight1 * a1 + weight2 * a2
                            if walk == 1:
                                bound = nearest[q, p] * TIED
                                if triangle[q, p] < 0 and inverse_depth >= bound:
                                    triangle[q, p] = 2 * (i * (width - 1) + j) + half
                            elif inverse_depth > nearest[q, p]:
                                bound = inverse_depth * TIED
                                if held[q, p] < bound:
                                    forgotten = forgotten or nearest[q, p] >= bound
                                    held[q, p] = inverse_depth
                                    triangle[q, p] = 2 * (i * (width - 1) + j) + half
                                nearest[q, p] = inverse_depth
        if not forgotten or walk == 1:
            break
        triangle[:] = -1


@kernel
@no_type_check
def choose(vertices, focal, triangle, start, stop):
    """Write the visible triangle of each pixel, or -1."""
    size = vertices.shape[1], vertices.shape[2]
    screen, nearest, held = np.empty((3, *size)), np.empty(size), np.empty(size)
    for n in range(start, stop):
        project(vertices[n], focal, screen)
        choose_in(screen, nearest, held, triangle[n])


@kernel
@no_type_check
def intersect(vertices, focal, triangle, uv, depth, start, stop):
    """Write canonical pixel coordinates and depth where each pixel's ray meets its triangle."""
    height, width = vertices.shape[1], vertices.shape[2]
    centre_u, centre_v = (width - 1) / 2, (height - 1) / 2
    for n in range(start, stop):
        for q in range(height):
            ray_y = (q - centre_v) / focal
            for p in range(width):
                index = triangle[n, q, p]
                if index < 0:
                    uv[n, q, p, 0] = 0
                    uv[n, q, p, 1] = 0
                    depth[n, q, p] = 0
                    continue
                ray_x = (p - centre_u) / focal
                half, i, j = index % 2, index // 2 // (width - 1), index // 2 % (width - 1)
                i0, j0, i1, j1, i2, j2 = i, j + half, i + half, j + 1, i + 1, j
                z0, z1, z2 = vertices[n, i0, j0, 2], vertices[n, i1, j1, 2], vertices[n, i2, j2, 2]
                x0, y0 = vertices[n, i0, j0, 0] - ray_x * z0, vertices[n, i0, j0, 1] - ray_y * z0
                x1, y1 = vertices[n, i1, j1, 0] - ray_x * z1, vertices[n, i1, j1, 1] - ray_y * z1
                x2, y2 = vertices[n, i2, j2, 0] - ray_x * z2, vertices[n, i2, j2, 1] - ray_y * z2
                w0, w1, w2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
                scale = 1 / (w0 + w1 + w2)
                uv[n, q, p, 0] = (w0 * j0 + w1 * j1 + w2 * j2) * scale
                uv[n, q, p, 1] = (w0 * i0 + w1 * i1 + w2 * i2) * scale
                depth[n, q, p] = (w0 * z0 + w1 * z1 + w2 * z2) * scale


@kernel
@no_type_check
def intersect_backward(grad_uv, grad_depth, vertices, focal, triangle, grad_vertices, start, stop):
    """Write the derivative of ``intersect`` with respect to the vertices (overwrites ``grad_vertices``)."""
    height, width = vertices.shape[1], vertices.shape[2]
    centre_u, centre_v = (width - 1) / 2, (height - 1) / 2
    total = np.empty((height, width, 3))
    for n in range(start, stop):
        total[:] = 0
        for q in range(height):
            ray_y = (q - centre_v) / focal
            for p in range(width):
                index = triangle[n, q, p]
                if index < 0:
                    continue
                ray_x = (p - centre_u) / focal
                half, i, j = index % 2, index // 2 // (width - 1), index // 2 % (width - 1)
                i0, j0, i1, j1, i2, j2 = i, j + half, i + half, j + 1, i + 1, j
                z0, z1, z2 = vertices[n, i0, j0, 2], vertices[n, i1, j1, 2], vertices[n, i2, j2, 2]
                x0, y0 = vertices[n, i0, j0, 0] - ray_x * z0, vertices[n, i0, j0, 1] - ray_y * z0
                x1, y1 = vertices[n, i1, j1, 0] - ray_x * z1, vertices[n, i1, j1, 1] - ray_y * z1
                x2, y2 = vertices[n, i2, j2, 0] - ray_x * z2, vertices[n, i2, j2, 1] - ray_y * z2
                w0, w1, w2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
                scale = 1 / (w0 + w1 + w2)
                b0, b1, b2 = w0 * scale, w1 * scale, w2 * scale
                gu, gv, gz = grad_uv[n, q, p, 0], grad_uv[n, q, p, 1], grad_depth[n, q, p]
                # Derivatives by the barycentric weights b, then by the unnormalised w, then by q = (x, y).
                gb0 = gu * j0 + gv * i0 + gz * z0
                gb1 = gu * j1 + gv * i1 + gz * z1
                gb2 = gu * j2 + gv * i2 + gz * z2
                mean = b0 * gb0 + b1 * gb1 + b2 * gb2
                gw0, gw1, gw2 = (gb0 - mean) * scale, (gb1 - mean) * scale, (gb2 - mean) * scale
                gx0, gy0 = gw2 * y1 - gw1 * y2, gw1 * x2 - gw2 * x1
                gx1, gy1 = gw0 * y2 - gw2 * y0, gw2 * x0 - gw0 * x2
                gx2, gy2 = gw1 * y0 - gw0 * y1, gw0 * x1 - gw1 * x0
                total[i0, j0, 0] += gx0
                total[i0, j0, 1] += gy0
                total[i0, j0, 2] += gz * b0 - ray_x * gx0 - ray_y * gy0
                total[i1, j1, 0] += gx1
                total[i1, j1, 1] += gy1
                total[i1, j1, 2] += gz * b1 - ray_x * gx1 - ray_y * gy1
                total[i2, j2, 0] += gx2
                total[i2, j2, 1] += gy2
                total[i2, j2, 2] += gz * b2 - ray_x * gx2 - ray_y * gy2
        grad_vertices[n] = total
