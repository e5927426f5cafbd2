"""Bilinear look-up in Triton, a lane per pixel; importing this module imports Triton."""

from typing import no_type_check

import triton
import triton.language as tl

from derender.render.triton_parts import accumulate, lanes, magnitude, note_largest


@triton.jit
@no_type_check
def cell(u, v, height, width):
    """Row and column of the cell that holds (u, v), border cells continued, and where in it the point lies.

    Coordinates are clipped before they become integers: a NaN must not become an address.
    """
    j = tl.where(u > 0, tl.minimum(u, width - 2), 0.0).to(tl.int32)
    i = tl.where(v > 0, tl.minimum(v, height - 2), 0.0).to(tl.int32)
    return i, j, u - j, v - i


@triton.jit
@no_type_check
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


@triton.jit
@no_type_check
def spread(grad_image, place, gradient, across, down, width, seen, unit, MODE: tl.constexpr):
    """Add a pixel's gradient to the four values it was made of."""
    accumulate(grad_image + place, gradient * (1 - across) * (1 - down), seen, unit, MODE)
    accumulate(grad_image + place + 1, gradient * across * (1 - down), seen, unit, MODE)
    accumulate(grad_image + place + width, gradient * (1 - across) * down, seen, unit, MODE)
    accumulate(grad_image + place + width + 1, gradient * across * down, seen, unit, MODE)


@triton.jit
@no_type_check
def forward(image, uv, mask, colour, height, width, pixels, CHANNELS: tl.constexpr, BLOCK: tl.constexpr):
    """Write the image's value at each (u, v), 0 where the mask is 0; ``pixels`` counts those looked up."""
    n, pixel, live = lanes(pixels, BLOCK)
    place = n * pixels + pixel
    seen = live & (tl.load(mask + place, mask=live, other=0) > 0)
    u = tl.load(uv + place * 2, mask=seen, other=0)
    v = tl.load(uv + place * 2 + 1, mask=seen, other=0)
    i, j, across, down = cell(u, v, height, width)
    for channel in tl.static_range(CHANNELS):
        plane = n * CHANNELS + channel
        value, _, _ = look_up(image, plane * height * width + i * width + j, across, down, width, seen)
        tl.store(colour + plane * pixels + pixel, tl.where(seen, value, 0.0), mask=live)


@triton.jit
@no_type_check
def backward(
    grad, image, uv, mask, grad_uv, grad_image, units, largest, height, width, pixels,
    CHANNELS: tl.constexpr, MODE: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the derivative by the coordinates, add that by the image (or note its largest summand)."""
    n, pixel, live = lanes(pixels, BLOCK)
    place = n * pixels + pixel
    seen = live & (tl.load(mask + place, mask=live, other=0) > 0)
    u = tl.load(uv + place * 2, mask=seen, other=0)
    v = tl.load(uv + place * 2 + 1, mask=seen, other=0)
    i, j, across, down = cell(u, v, height, width)
    gu, gv = across * 0, down * 0
    most = magnitude(gu, seen)
    unit = tl.load(units + n)
    for channel in tl.static_range(CHANNELS):
        plane = n * CHANNELS + channel
        gradient = tl.load(grad + plane * pixels + pixel, mask=seen, other=0)
        at = plane * height * width + i * width + j
        if MODE == 1:
            most = tl.maximum(most, magnitude(gradient, seen))
        else:
            _, along_u, along_v = look_up(image, at, across, down, width, seen)
            gu += gradient * along_u
            gv += gradient * along_v
            spread(grad_image, at, gradient, across, down, width, seen, unit, MODE)
    if MODE == 1:
        note_largest(largest + n, most)
    else:
        tl.store(grad_uv + place * 2, gu, mask=live)
        tl.store(grad_uv + place * 2 + 1, gv, mask=live)
