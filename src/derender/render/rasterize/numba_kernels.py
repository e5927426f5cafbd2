"""The rasteriser's inner loops for Numba; importing this module imports Numba.

``project`` and ``choose_in`` work on one image, for warping; ``choose_in`` walks its triangles in order with
a z-buffer. Arithmetic is float64 in the order of operations of ``reference.py``, so that both decide alike.
"""

from math import ceil, floor

import numpy as np

from derender.render.numba_threads import kernel
from derender.render.rasterize import reference as rule

REACH = 3 * rule.EDGE_TOLERANCE
TIED = 1 - rule.TIE_TOLERANCE


@kernel
def project(points, focal, screen):
    """Write where points (H, W, 3) land in the image and their inverse depth, 0 for one left out."""
    height, width = points.shape[0], points.shape[1]
    centre_u, centre_v = (width - 1) / 2, (height - 1) / 2
    for i in range(height):
        for j in range(width):
            z = np.float64(points[i, j, 2])
            inverse_z = 1 / z
            u = np.float64(points[i, j, 0]) * inverse_z * focal + centre_u
            v = np.float64(points[i, j, 1]) * inverse_z * focal + centre_v
            seen = z > rule.NEAR_Z and abs(u) <= rule.MAX_COORDINATE_PX and abs(v) <= rule.MAX_COORDINATE_PX
            screen[0, i, j] = u
            screen[1, i, j] = v
            screen[2, i, j] = inverse_z if seen else 0.0


@kernel
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
                    if not abs(area) > rule.MIN_TWICE_AREA_PX2:
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
                            if min(weight0, weight1, weight2) < -rule.EDGE_TOLERANCE:
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
def choose(screen, triangle, start, stop):
    """Write the visible triangle of each pixel, or -1."""
    size = triangle.shape[1], triangle.shape[2]
    nearest, held = np.empty(size), np.empty(size)
    for n in range(start, stop):
        choose_in(screen[:, n], nearest, held, triangle[n])
