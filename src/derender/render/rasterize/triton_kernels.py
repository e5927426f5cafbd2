"""The rasteriser's Triton kernels; importing this module imports Triton.

In ``choose`` a lane per triangle walks its bounding box, twice: the first walk leaves each pixel's nearest
inverse depth, the second the lowest triangle within the tie tolerance of it. Both are extremes of integers (a
positive float's bits order like the float), so the order of lanes changes nothing. ``project`` (a vertex),
``meet`` and ``meet_backward`` (a pixel's ray and its triangle) are parts of warping's kernels. Arithmetic is
float64 in the order of operations of ``reference.py``.
"""

import triton.language as tl

from derender.render.rasterize import reference as rule
from derender.render.triton_parts import kernel, lanes

NEAR_Z = tl.constexpr(rule.NEAR_Z)
MIN_TWICE_AREA_PX2 = tl.constexpr(rule.MIN_TWICE_AREA_PX2)
MAX_COORDINATE_PX = tl.constexpr(rule.MAX_COORDINATE_PX)
EDGE_TOLERANCE = tl.constexpr(rule.EDGE_TOLERANCE)
REACH = tl.constexpr(3 * rule.EDGE_TOLERANCE)
TIED = tl.constexpr(1 - rule.TIE_TOLERANCE)
NO_TRIANGLE = tl.constexpr(rule.NO_TRIANGLE)


@kernel
def project(x, y, z, focal, place, live, us, vs, inverse_zs, height, width):
    """Write where vertices land in the image and their inverse depth; 0 for that marks one left out."""
    seen = z > NEAR_Z
    inverse_z = 1 / tl.where(seen, z, 1.0)
    u = x * inverse_z * focal + (width - 1) * 0.5
    v = y * inverse_z * focal + (height - 1) * 0.5
    seen = seen & (tl.abs(u) <= MAX_COORDINATE_PX) & (tl.abs(v) <= MAX_COORDINATE_PX)
    tl.store(us + place, tl.where(seen, u, 0.0), mask=live)
    tl.store(vs + place, tl.where(seen, v, 0.0), mask=live)
    tl.store(inverse_zs + place, tl.where(seen, inverse_z, 0.0), mask=live)


@kernel
def corners(triangle, width):
    """Row and column of a triangle's three vertices."""
    half, cell = triangle % 2, triangle // 2
    i, j = cell // (width - 1), cell % (width - 1)
    return i, j + half, i + half, j + 1, i + 1, j


@kernel
def choose(
    us, vs, inverse_zs, nearest_bits, nearest, first, height, width, SECOND: tl.constexpr, BLOCK: tl.constexpr
):
    """First walk: raise ``nearest`` at every pixel a triangle covers. Second: lower ``first`` where tied."""
    # nearest_bits (int64, zeros before) and nearest (float64) are the same memory
    image, triangle, live = lanes(2 * (height - 1) * (width - 1), BLOCK)
    base = image * height * width
    i0, j0, i1, j1, i2, j2 = corners(triangle, width)
    place0, place1, place2 = base + i0 * width + j0, base + i1 * width + j1, base + i2 * width + j2
    a0 = tl.load(inverse_zs + place0, mask=live, other=0)
    a1 = tl.load(inverse_zs + place1, mask=live, other=0)
    a2 = tl.load(inverse_zs + place2, mask=live, other=0)
    live = live & (a0 != 0) & (a1 != 0) & (a2 != 0)
    u0 = tl.load(us + place0, mask=live, other=0)
    u1 = tl.load(us + place1, mask=live, other=0)
    u2 = tl.load(us + place2, mask=live, other=0)
    v0 = tl.load(vs + place0, mask=live, other=0)
    v1 = tl.load(vs + place1, mask=live, other=0)
    v2 = tl.load(vs + place2, mask=live, other=0)
    area = (u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0)
    live = live & (tl.abs(area) > MIN_TWICE_AREA_PX2)
    scale = 1 / tl.where(live, area, 1.0)

    low, high = tl.minimum(tl.minimum(u0, u1), u2), tl.maximum(tl.maximum(u0, u1), u2)
    margin = REACH * (high - low)
    first_u = tl.ceil(tl.maximum(low - margin, 0.0)).to(tl.int32)
    last_u = tl.minimum(tl.floor(high + margin), width - 1).to(tl.int32)
    low, high = tl.minimum(tl.minimum(v0, v1), v2), tl.maximum(tl.maximum(v0, v1), v2)
    margin = REACH * (high - low)
    first_v = tl.ceil(tl.maximum(low - margin, 0.0)).to(tl.int32)
    last_v = tl.minimum(tl.floor(high + margin), height - 1).to(tl.int32)
    live = live & (first_u <= last_u) & (first_v <= last_v)
    count = tl.where(live, (last_u - first_u + 1) * (last_v - first_v + 1), 0)

    p, q = first_u, first_v
    for step in range(tl.max(count, 0)):
        du0, du1, du2 = u0 - p, u1 - p, u2 - p
        dv0, dv1, dv2 = v0 - q, v1 - q, v2 - q
        weight0 = (du1 * dv2 - du2 * dv1) * scale
        weight1 = (du2 * dv0 - du0 * dv2) * scale
        weight2 = (du0 * dv1 - du1 * dv0) * scale
        inside = (weight0 >= -EDGE_TOLERANCE) & (weight1 >= -EDGE_TOLERANCE) & (weight2 >= -EDGE_TOLERANCE)
        inverse_depth = weight0 * a0 + weight1 * a1 + weight2 * a2
        inside = inside & (step < count) & (inverse_depth > 0)
        place = base + q * width + p
        if SECOND:
            bound = tl.load(nearest + place, mask=inside, other=0) * TIED
            tl.atomic_min(first + place, triangle, mask=inside & (inverse_depth >= bound), sem="relaxed")
        else:
            bits = inverse_depth.to(tl.int64, bitcast=True)
            tl.atomic_max(nearest_bits + place, bits, mask=inside, sem="relaxed")
        ended = p >= last_u
        p = tl.where(ended, first_u, p + 1)
        q = tl.where(ended, q + 1, q)


@kernel
def meet(ray_x, ray_y, x0, y0, z0, x1, y1, z1, x2, y2, z2, seen):
    """Where rays (ray_x, ray_y, 1) meet triangles: barycentric weights, and what their derivative needs."""
    x0, y0 = x0 - ray_x * z0, y0 - ray_y * z0
    x1, y1 = x1 - ray_x * z1, y1 - ray_y * z1
    x2, y2 = x2 - ray_x * z2, y2 - ray_y * z2
    w0, w1, w2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
    scale = 1 / tl.where(seen, w0 + w1 + w2, 1.0)
    return w0 * scale, w1 * scale, w2 * scale, scale, x0, y0, x1, y1, x2, y2


@kernel
def meet_backward(gb0, gb1, gb2, b0, b1, b2, scale, x0, y0, x1, y1, x2, y2):
    """From derivatives by the barycentric weights to derivatives by the vertices' x and y."""
    mean = b0 * gb0 + b1 * gb1 + b2 * gb2
    gw0, gw1, gw2 = (gb0 - mean) * scale, (gb1 - mean) * scale, (gb2 - mean) * scale
    gx0, gy0 = gw2 * y1 - gw1 * y2, gw1 * x2 - gw2 * x1
    gx1, gy1 = gw0 * y2 - gw2 * y0, gw2 * x0 - gw0 * x2
    gx2, gy2 = gw1 * y0 - gw0 * y1, gw0 * x1 - gw1 * x0
    return gx0, gy0, gx1, gy1, gx2, gy2
