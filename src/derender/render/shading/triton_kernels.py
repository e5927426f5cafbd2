"""Lambertian shading of a depth map in Triton, a lane per pixel; importing this module imports Triton.

``forward`` and ``backward`` find a pixel's normal from its four neighbours' depths, as ``scene/normals.py``
does. ``backward`` leaves the derivatives by the two slopes. ``gather`` collects them for each depth from the
pixels whose slope it entered: nothing is added by two lanes.
"""

import triton.language as tl

from derender.render.triton_parts import float64, kernel, lanes


@kernel
def slope(depth, place, step, at, size, live):
    """(next - previous) / (next + previous) along an axis; one-sided over its nearer value at the border."""
    before = tl.load(depth + place - tl.where(at > 0, step, 0), mask=live, other=1)
    after = tl.load(depth + place + tl.where(at < size - 1, step, 0), mask=live, other=1)
    below = tl.where(at == 0, after, tl.where(at == size - 1, before, after + before))
    return (after - before) / below


@kernel
def cosine(depth, lamp, n, pixel, live, focal, height, width):
    """Cosine between normal and light with what its derivative needs: the normal, its length, the light."""
    i, j, place = pixel // width, pixel % width, n * height * width + pixel
    slope_u, slope_v = slope(depth, place, 1, j, width, live), slope(depth, place, width, i, height, live)
    kind = slope_u.dtype
    u, v = (j - (width - 1) * 0.5).to(kind), (i - (height - 1) * 0.5).to(kind)
    x, y, z = -focal * slope_u, -focal * slope_v, 1 + u * slope_u + v * slope_v
    length = tl.sqrt(x * x + y * y + z * z)
    x, y, z = x / length, y / length, z / length
    light_x, light_y = tl.load(lamp + n * 5 + 2), tl.load(lamp + n * 5 + 3)
    light_z = tl.load(lamp + n * 5 + 4)
    return x * light_x + y * light_y + z * light_z, x, y, z, length, light_x, light_y, light_z, u, v


@kernel
def forward(
    depth, albedo, lamp, image, focal_bits, height, width, CHANNELS: tl.constexpr, BLOCK: tl.constexpr
):
    n, pixel, live = lanes(height * width, BLOCK)
    focal = float64(focal_bits).to(depth.dtype.element_ty)
    facing, _, _, _, _, _, _, _, _, _ = cosine(depth, lamp, n, pixel, live, focal, height, width)
    shading = tl.load(lamp + n * 5) + tl.load(lamp + n * 5 + 1) * tl.maximum(facing, 0.0)
    for channel in tl.static_range(CHANNELS):
        place = (n * CHANNELS + channel) * height * width + pixel
        tl.store(image + place, tl.load(albedo + place, mask=live, other=0) * shading, mask=live)


@kernel
def backward(
    grad, depth, albedo, lamp, grad_albedo, grad_slope_u, grad_slope_v, grad_lamp, focal_bits, height, width,
    CHANNELS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write derivatives by albedo and slopes, and each program's part (5) of those by the lamp."""
    n, pixel, live = lanes(height * width, BLOCK)
    focal = float64(focal_bits).to(depth.dtype.element_ty)
    seen = cosine(depth, lamp, n, pixel, live, focal, height, width)
    facing, x, y, z, length, light_x, light_y, light_z, u, v = seen
    diffuse, lit = tl.load(lamp + n * 5 + 1), tl.maximum(facing, 0.0)
    shading = tl.load(lamp + n * 5) + diffuse * lit
    by_shading = facing * 0
    for channel in tl.static_range(CHANNELS):
        place = (n * CHANNELS + channel) * height * width + pixel
        gradient = tl.load(grad + place, mask=live, other=0)
        by_shading += gradient * tl.load(albedo + place, mask=live, other=0)
        tl.store(grad_albedo + place, gradient * shading, mask=live)
    by_cosine = tl.where(facing > 0, by_shading * diffuse, 0.0)
    by_x = by_cosine * (light_x - x * facing) / length
    by_y = by_cosine * (light_y - y * facing) / length
    by_z = by_cosine * (light_z - z * facing) / length
    place = n * height * width + pixel
    tl.store(grad_slope_u + place, u * by_z - focal * by_x, mask=live)
    tl.store(grad_slope_v + place, v * by_z - focal * by_y, mask=live)
    part = grad_lamp + tl.program_id(0).to(tl.int64) * 5
    tl.store(part, tl.sum(tl.where(live, by_shading, 0.0), 0))
    tl.store(part + 1, tl.sum(tl.where(live, by_shading * lit, 0.0), 0))
    tl.store(part + 2, tl.sum(tl.where(live, by_cosine * x, 0.0), 0))
    tl.store(part + 3, tl.sum(tl.where(live, by_cosine * y, 0.0), 0))
    tl.store(part + 4, tl.sum(tl.where(live, by_cosine * z, 0.0), 0))


@kernel
def from_slopes(grad_slope, depth, place, step, at, size, live):
    """The derivative by a pixel's depth through the slopes along one axis that it entered."""
    own = tl.load(depth + place, mask=live, other=1)
    has_before, has_after = live & (at > 0), live & (at < size - 1)
    before = tl.load(depth + place - step, mask=has_before, other=1)
    after = tl.load(depth + place + step, mask=has_after, other=1)
    farther_before = tl.load(depth + place - 2 * step, mask=live & (at > 1), other=1)
    farther_after = tl.load(depth + place + 2 * step, mask=live & (at < size - 2), other=1)
    slope_before = tl.load(grad_slope + place - step, mask=has_before, other=0)
    slope_after = tl.load(grad_slope + place + step, mask=has_after, other=0)
    # as the next value of the slope before, then as the previous value of the slope after
    below = own + farther_before
    inner, first = 2 * farther_before / (below * below), before / (own * own)
    total = slope_before * tl.where(at == 1, first, inner)
    below = own + farther_after
    inner, last = 2 * farther_after / (below * below), after / (own * own)
    total -= slope_after * tl.where(at == size - 2, last, inner)
    # as its own pixel's value, which enters a slope at the border alone
    slope_own = tl.load(grad_slope + place, mask=live, other=0)
    total -= tl.where(at == 0, slope_own / after, 0.0)
    return total + tl.where(at == size - 1, slope_own / before, 0.0)


@kernel
def gather(depth, grad_slope_u, grad_slope_v, grad_depth, height, width, BLOCK: tl.constexpr):
    n, pixel, live = lanes(height * width, BLOCK)
    place = n * height * width + pixel
    total = from_slopes(grad_slope_u, depth, place, 1, pixel % width, width, live)
    total += from_slopes(grad_slope_v, depth, place, width, pixel // width, height, live)
    tl.store(grad_depth + place, total, mask=live)
