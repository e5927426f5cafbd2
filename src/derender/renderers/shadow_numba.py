"""The search of `lambert-shadow` for the CPU: the step at which each ray runs deepest below the surface.

The same as ``shadow._lowest_step``; no derivative is needed, as clearance is differentiated at that step
alone. A ray ends where nothing further on could be deeper, given the nearest surface that it can reach.
"""

from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Int32
from torch import Tensor

from derender.render.numba_threads import array, kernel, over_images
from derender.renderers.renderer import Maps


def lowest_step(depth: Maps, towards: Float[Tensor, "n 3"], focal: float) -> Int32[Tensor, "n h w"]:
    """The step of the smallest clearance; 0 where it is nowhere below 0."""
    step = torch.empty(depth.shape, dtype=torch.int32)
    over_images(_search, len(depth), array(depth), array(towards), focal, array(step))
    return step


@partial(kernel, fastmath={"contract"})
def _search(depth, towards, focal, step, first, last):
    height, width = depth.shape[1:]
    zero, one, twelve = depth.dtype.type(0), depth.dtype.type(1), depth.dtype.type(12)
    focal, middle_u, middle_v = zero + focal, zero + 0.5 * (width - 1), zero + 0.5 * (height - 1)
    least, ahead = focal * depth.dtype.type(1e-4), np.empty((height, width), depth.dtype)
    for n in range(first, last):
        tx, ty, tz = towards[n, 0], towards[n, 1], towards[n, 2]
        own = depth[n]
        _nearest_ahead(own, focal * tx / tz + middle_u, focal * ty / tz + middle_v, ahead)
        for i in range(height):
            for j in range(width):
                z0, nearest = own[i, j], ahead[i, j]
                right, down = focal * tx - (j - middle_u) * tz, focal * ty - (i - middle_v) * tz
                pixel = one / max(np.sqrt(right * right + down * down), least)
                right, down = right * pixel, down * pixel
                rise = -tz * pixel
                lowest, best = zero, 0
                for number in range(1, height + width):
                    pixels = number * (one + number / twelve)
                    nearer = one + pixels * rise
                    if nearest * nearer - z0 >= lowest * pixels:
                        break
                    u, v = j + pixels * right, i + pixels * down
                    if u < 0 or v < 0 or u > width - 1 or v > height - 1:
                        break
                    p, q = min(int(u), width - 2), min(int(v), height - 2)
                    a, b = u - p, v - q
                    above = own[q, p] + a * (own[q, p + 1] - own[q, p])
                    below = own[q + 1, p] + a * (own[q + 1, p + 1] - own[q + 1, p])
                    behind = (above + b * (below - above)) * nearer - z0
                    if behind < lowest * pixels:
                        lowest, best = behind / pixels, number
                step[n, i, j] = best


@kernel
def _nearest_ahead(own, source_u, source_v, ahead):
    """Write for each pixel the smallest depth of all that lie further from the source in rows and columns."""
    # seen by the camera, parallel rays run away from the point that they come from
    height, width = own.shape
    for k in range(height):
        i = k
        if k > source_v:  # from the last row back
            i = height - 1 - (k - max(int(np.floor(source_v)) + 1, 0))
        outer_i = i + 1 if i > source_v else i - 1
        for m in range(width):
            j = m
            if m > source_u:
                j = width - 1 - (m - max(int(np.floor(source_u)) + 1, 0))
            outer_j = j + 1 if j > source_u else j - 1
            nearest = own[i, j]
            if 0 <= outer_i < height:
                nearest = min(nearest, ahead[outer_i, j])
            if 0 <= outer_j < width:
                nearest = min(nearest, ahead[i, outer_j])
            ahead[i, j] = nearest
