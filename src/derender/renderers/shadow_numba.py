"""The search of `lambert-shadow` for the CPU: which step of each ray has the smallest clearance.

The same as ``shadow._lowest_step``; no derivative is needed, as clearance is differentiated at that
step alone.
"""

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from derender.render.numba_threads import array, kernel, over_images
from derender.scene.camera import focal_px


def lowest_step(
    depth: Float[Tensor, "n h w"], towards: Float[Tensor, "n 3"], fov_deg: float
) -> Int64[Tensor, "n h w"]:
    """The step of the smallest clearance; 0 where the ray leaves the range of depths free."""
    step = torch.empty_like(depth, dtype=torch.int64, memory_format=torch.contiguous_format)
    focal = focal_px(depth.shape[2], fov_deg)
    over_images(_search, len(depth), array(depth), array(towards), focal, array(step))
    return step


@kernel
@no_type_check
def _search(depth, towards, focal, step, first, last):
    height, width = depth.shape[1:]
    middle_u, middle_v = 0.5 * (width - 1), 0.5 * (height - 1)
    for n in range(first, last):
        tx, ty, tz = towards[n, 0], towards[n, 1], towards[n, 2]
        own, slant = depth[n], max(np.sqrt(tx * tx + ty * ty), depth.dtype.type(1e-4))
        nearest = own.min()
        for i in range(height):
            for j in range(width):
                z0 = own[i, j]
                x0, y0 = z0 * (j - middle_u) / focal, z0 * (i - middle_v) / focal
                length = z0 / (focal * slant)
                lowest, best = 1.0, 0
                for number in range(1, height + width - 1):
                    gone = number * length
                    z = z0 + gone * tz
                    if z <= nearest:
                        break
                    u = (x0 + gone * tx) / z * focal + middle_u
                    v = (y0 + gone * ty) / z * focal + middle_v
                    if u < 0.0 or v < 0.0 or u > width - 1 or v > height - 1:
                        break
                    p, q = min(int(u), width - 2), min(int(v), height - 2)
                    a, b = u - p, v - q
                    above = own[q, p] + a * (own[q, p + 1] - own[q, p])
                    below = own[q + 1, p] + a * (own[q + 1, p + 1] - own[q + 1, p])
                    behind = above + b * (below - above) - z
                    if behind < lowest * gone:
                        lowest, best = behind / gone, number
                step[n, i, j] = best
