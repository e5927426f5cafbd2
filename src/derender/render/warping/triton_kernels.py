"""From a depth map and a camera's motion to the image, in Triton; importing this module imports Triton.

``project_depth`` finds where the surface's vertices land. The rasteriser's ``choose`` then decides what each
pixel shows. ``show`` meets the pixel's ray with its triangle and looks the colour up, all in one lane.
``show_backward`` is the derivative of ``show``. Points are never stored: a vertex is rotation times its ray
times its depth, plus offset, in float64. Colours are computed in the image's own dtype.
"""

import triton.language as tl

from derender.render.rasterize.triton_kernels import NO_TRIANGLE, corners, meet, meet_backward, project
from derender.render.triton_parts import accumulate, float64, kernel, lanes, magnitude, note_largest


@kernel
def cell(u, v, height, width):
    """Row and column of the cell that holds (u, v), the border's continued, and the point's place in it."""
    # coordinates are clipped before they become integers: a NaN must not become an address
    j = tl.where(u > 0, tl.minimum(u, width - 2), 0.0).to(tl.int32)
    i = tl.where(v > 0, tl.minimum(v, height - 2), 0.0).to(tl.int32)
    return i, j, u - j, v - i


@kernel
def look_up(image, place, across, down, width, seen):
    """The value at a point, and its derivatives along u and v."""
    a = tl.load(image + place, mask=seen, other=0)
    b = tl.load(image + place + 1, mask=seen, other=0)
    c = tl.load(image + place + width, mask=seen, other=0)
    d = tl.load(image + place + width + 1, mask=seen, other=0)
    upper, lower = a * (1 - across) + b * across, c * (1 - across) + d * across
    along_u = (b - a) * (1 - down) + (d - c) * down
    along_v = (c - a) * (1 - across) + (d - b) * across
    return upper * (1 - down) + lower * down, along_u, along_v


@kernel
def spread(grad_image, place, gradient, across, down, width, seen, unit, MODE: tl.constexpr):
    """Add a pixel's gradient to the four values it was made of."""
    accumulate(grad_image + place, gradient * (1 - across) * (1 - down), seen, unit, MODE)
    accumulate(grad_image + place + 1, gradient * across * (1 - down), seen, unit, MODE)
    accumulate(grad_image + place + width, gradient * (1 - across) * down, seen, unit, MODE)
    accumulate(grad_image + place + width + 1, gradient * across * down, seen, unit, MODE)


@kernel
def surface(depth, rotation, offset, n, i, j, focal, height, width, live):
    """Vertex (i, j) of image n: its depth, its ray (x, y, 1), the ray turned, the point for the camera."""
    distance = tl.load(depth + n * height * width + i * width + j, mask=live, other=0).to(tl.float64)
    ray_x = (j - (width - 1) * 0.5).to(tl.float64) / focal
    ray_y = (i - (height - 1) * 0.5).to(tl.float64) / focal
    r, t = rotation + n * 9, offset + n * 3
    turned_x = tl.load(r) * ray_x + tl.load(r + 1) * ray_y + tl.load(r + 2)
    turned_y = tl.load(r + 3) * ray_x + tl.load(r + 4) * ray_y + tl.load(r + 5)
    turned_z = tl.load(r + 6) * ray_x + tl.load(r + 7) * ray_y + tl.load(r + 8)
    x, y = distance * turned_x + tl.load(t), distance * turned_y + tl.load(t + 1)
    return distance, ray_x, ray_y, turned_x, turned_y, turned_z, x, y, distance * turned_z + tl.load(t + 2)


@kernel
def project_depth(
    depth, rotation, offset, us, vs, inverse_zs, focal_bits, height, width, BLOCK: tl.constexpr
):
    n, pixel, live = lanes(height * width, BLOCK)
    i, j, focal = pixel // width, pixel % width, float64(focal_bits)
    _, _, _, _, _, _, x, y, z = surface(depth, rotation, offset, n, i, j, focal, height, width, live)
    project(x, y, z, focal, n * height * width + pixel, live, us, vs, inverse_zs, height, width)


@kernel
def show(
    image, depth, rotation, offset, triangle, colour, seen_depth, mask, focal_bits, height, width,
    CHANNELS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write colour, depth and mask; turn the mark of a pixel without triangle into -1."""
    n, pixel, live = lanes(height * width, BLOCK)
    base, focal = n * height * width, float64(focal_bits)
    index = tl.load(triangle + base + pixel, mask=live, other=NO_TRIANGLE)
    seen = index != NO_TRIANGLE
    i0, j0, i1, j1, i2, j2 = corners(tl.where(seen, index, 0), width)
    _, _, _, _, _, _, x0, y0, z0 = surface(depth, rotation, offset, n, i0, j0, focal, height, width, seen)
    _, _, _, _, _, _, x1, y1, z1 = surface(depth, rotation, offset, n, i1, j1, focal, height, width, seen)
    _, _, _, _, _, _, x2, y2, z2 = surface(depth, rotation, offset, n, i2, j2, focal, height, width, seen)
    ray_x = (pixel % width - (width - 1) * 0.5).to(tl.float64) / focal
    ray_y = (pixel // width - (height - 1) * 0.5).to(tl.float64) / focal
    b0, b1, b2, _, _, _, _, _, _, _ = meet(ray_x, ray_y, x0, y0, z0, x1, y1, z1, x2, y2, z2, seen)
    kind = image.dtype.element_ty
    z = b0 * z0 + b1 * z1 + b2 * z2
    tl.store(seen_depth + base + pixel, tl.where(seen, z, 0.0).to(kind), mask=live)
    tl.store(mask + base + pixel, seen.to(kind), mask=live)
    tl.store(triangle + base + pixel, tl.where(seen, index, -1), mask=live)
    u = tl.where(seen, b0 * j0 + b1 * j1 + b2 * j2, 0.0).to(kind)
    v = tl.where(seen, b0 * i0 + b1 * i1 + b2 * i2, 0.0).to(kind)
    i, j, across, down = cell(u, v, height, width)
    for channel in tl.static_range(CHANNELS):
        plane = (n * CHANNELS + channel) * height * width
        value, _, _ = look_up(image, plane + i * width + j, across, down, width, seen)
        tl.store(colour + plane + pixel, tl.where(seen, value, 0.0), mask=live)


@kernel
def show_backward(
    grad_colour, grad_depth_seen, image, depth, rotation, offset, triangle, grad_motion,
    grad_image, grad_depth, units, largest, focal_bits, height, width,
    CHANNELS: tl.constexpr, MODE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Add derivatives by the image and the depth map; write each program's part (12) of those by the motion.

    ``units`` and ``largest`` hold two numbers an image: for ``grad_image`` and for ``grad_depth``.
    """
    n, pixel, live = lanes(height * width, BLOCK)
    base, focal = n * height * width, float64(focal_bits)
    index = tl.load(triangle + base + pixel, mask=live, other=-1)
    seen = index >= 0
    i0, j0, i1, j1, i2, j2 = corners(tl.where(seen, index, 0), width)
    at0 = surface(depth, rotation, offset, n, i0, j0, focal, height, width, seen)
    at1 = surface(depth, rotation, offset, n, i1, j1, focal, height, width, seen)
    at2 = surface(depth, rotation, offset, n, i2, j2, focal, height, width, seen)
    d0, rx0, ry0, tx0, ty0, tz0, x0, y0, z0 = at0
    d1, rx1, ry1, tx1, ty1, tz1, x1, y1, z1 = at1
    d2, rx2, ry2, tx2, ty2, tz2, x2, y2, z2 = at2
    ray_x = (pixel % width - (width - 1) * 0.5).to(tl.float64) / focal
    ray_y = (pixel // width - (height - 1) * 0.5).to(tl.float64) / focal
    b0, b1, b2, scale, x0, y0, x1, y1, x2, y2 = meet(ray_x, ray_y, x0, y0, z0, x1, y1, z1, x2, y2, z2, seen)

    kind = image.dtype.element_ty
    u = tl.where(seen, b0 * j0 + b1 * j1 + b2 * j2, 0.0).to(kind)
    v = tl.where(seen, b0 * i0 + b1 * i1 + b2 * i2, 0.0).to(kind)
    i, j, across, down = cell(u, v, height, width)
    gu, gv = across * 0, down * 0
    most = magnitude(gu, seen)
    image_unit, depth_unit = tl.load(units + n * 2), tl.load(units + n * 2 + 1)
    for channel in tl.static_range(CHANNELS):
        plane = (n * CHANNELS + channel) * height * width
        gradient = tl.load(grad_colour + plane + pixel, mask=seen, other=0)
        at = plane + i * width + j
        _, along_u, along_v = look_up(image, at, across, down, width, seen)
        gu += gradient * along_u
        gv += gradient * along_v
        if MODE == 1:
            most = tl.maximum(most, magnitude(gradient, seen))
        else:
            spread(grad_image, at, gradient, across, down, width, seen, image_unit, MODE)

    gu, gv = gu.to(tl.float64), gv.to(tl.float64)
    gz = tl.load(grad_depth_seen + base + pixel, mask=seen, other=0).to(tl.float64)
    gb0 = gu * j0 + gv * i0 + gz * z0
    gb1 = gu * j1 + gv * i1 + gz * z1
    gb2 = gu * j2 + gv * i2 + gz * z2
    gx0, gy0, gx1, gy1, gx2, gy2 = meet_backward(gb0, gb1, gb2, b0, b1, b2, scale, x0, y0, x1, y1, x2, y2)
    gz0 = gz * b0 - ray_x * gx0 - ray_y * gy0
    gz1 = gz * b1 - ray_x * gx1 - ray_y * gy1
    gz2 = gz * b2 - ray_x * gx2 - ray_y * gy2
    gd0 = gx0 * tx0 + gy0 * ty0 + gz0 * tz0
    gd1 = gx1 * tx1 + gy1 * ty1 + gz1 * tz1
    gd2 = gx2 * tx2 + gy2 * ty2 + gz2 * tz2
    if MODE == 1:
        note_largest(largest + n * 2, most)
        most = tl.maximum(tl.maximum(magnitude(gd0, seen), magnitude(gd1, seen)), magnitude(gd2, seen))
        note_largest(largest + n * 2 + 1, most)
    else:
        accumulate(grad_depth + base + i0 * width + j0, gd0, seen, depth_unit, MODE)
        accumulate(grad_depth + base + i1 * width + j1, gd1, seen, depth_unit, MODE)
        accumulate(grad_depth + base + i2 * width + j2, gd2, seen, depth_unit, MODE)
        part = grad_motion + tl.program_id(0).to(tl.int64) * 12
        sum_motion(part, gx0, gx1, gx2, d0, d1, d2, rx0, ry0, rx1, ry1, rx2, ry2, seen)
        sum_motion(part + 4, gy0, gy1, gy2, d0, d1, d2, rx0, ry0, rx1, ry1, rx2, ry2, seen)
        sum_motion(part + 8, gz0, gz1, gz2, d0, d1, d2, rx0, ry0, rx1, ry1, rx2, ry2, seen)


@kernel
def sum_motion(part, g0, g1, g2, d0, d1, d2, rx0, ry0, rx1, ry1, rx2, ry2, seen):
    """Sums over the block that make one row of the rotation's gradient, and one number of the offset's."""
    gd0, gd1, gd2 = g0 * d0, g1 * d1, g2 * d2
    tl.store(part, tl.sum(tl.where(seen, gd0 * rx0 + gd1 * rx1 + gd2 * rx2, 0.0), 0))
    tl.store(part + 1, tl.sum(tl.where(seen, gd0 * ry0 + gd1 * ry1 + gd2 * ry2, 0.0), 0))
    tl.store(part + 2, tl.sum(tl.where(seen, gd0 + gd1 + gd2, 0.0), 0))
    tl.store(part + 3, tl.sum(tl.where(seen, g0 + g1 + g2, 0.0), 0))
