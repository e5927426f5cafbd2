"""Lambertian shading of a depth map for Numba, row by row; importing this module imports Numba.

Rows are worked on whole, so that the compiler can take several pixels at once. Arithmetic is in the maps' own
dtype; the lamp's gradient is summed in float64.
"""

import numpy as np

from derender.render.numba_threads import kernel


@kernel
def row_slopes(depth, i, along_u, along_v):
    """Write row i's relative slopes along both axes, as ``scene/normals.py`` defines them."""
    width, row = depth.shape[1], depth[i]
    for j in range(1, width - 1):
        along_u[j] = (row[j + 1] - row[j - 1]) / (row[j + 1] + row[j - 1])
    along_u[0] = (row[1] - row[0]) / row[1]
    along_u[width - 1] = (row[width - 1] - row[width - 2]) / row[width - 2]
    above, below, count_above, count_below = neighbours(depth, i)
    for j in range(width):
        along_v[j] = (below[j] - above[j]) / (below[j] * count_below + above[j] * count_above)


@kernel
def neighbours(rows, i):
    """The rows above and below row i, itself at the border, and which of them its slope's divisor counts."""
    last, one, none = len(rows) - 1, rows.dtype.type(1), rows.dtype.type(0)
    return rows[max(i - 1, 0)], rows[min(i + 1, last)], one if i > 0 else none, one if i < last else none


@kernel
def forward(depth, albedo, lamp, focal, image, start, stop):
    """Write albedo times shading."""
    channels, height, width = albedo.shape[1], albedo.shape[2], albedo.shape[3]
    kind = depth.dtype.type
    one, focal = kind(1), kind(focal)
    us = (np.arange(width) - (width - 1) / 2).astype(depth.dtype)
    along_u, along_v = np.empty(width, depth.dtype), np.empty(width, depth.dtype)
    shading = np.empty(width, depth.dtype)
    for n in range(start, stop):
        ambient, diffuse, light_x, light_y, light_z = lamp[n]
        for i in range(height):
            v = kind(i - (height - 1) / 2)
            row_slopes(depth[n], i, along_u, along_v)
            for j in range(width):
                x, y = -focal * along_u[j], -focal * along_v[j]
                z = one + us[j] * along_u[j] + v * along_v[j]
                facing = (x * light_x + y * light_y + z * light_z) / np.sqrt(x * x + y * y + z * z)
                shading[j] = ambient + diffuse * (facing if facing > 0 else kind(0))
            for c in range(channels):
                for j in range(width):
                    image[n, c, i, j] = albedo[n, c, i, j] * shading[j]


@kernel
def backward(grad, depth, albedo, lamp, focal, grad_depth, grad_albedo, grad_lamp, start, stop):
    """Write the derivatives by depth, albedo and lamp (overwrites all three outputs)."""
    channels, height, width = albedo.shape[1], albedo.shape[2], albedo.shape[3]
    kind = depth.dtype.type
    zero, one, two, focal = kind(0), kind(1), kind(2), kind(focal)
    us = (np.arange(width) - (width - 1) / 2).astype(depth.dtype)
    along_u, along_v = np.empty(width, depth.dtype), np.empty(width, depth.dtype)
    by_shading, shading = np.empty(width, depth.dtype), np.empty(width, depth.dtype)
    sums = np.empty((5, width), depth.dtype)
    for n in range(start, stop):
        ambient, diffuse, light_x, light_y, light_z = lamp[n]
        grad_depth[n] = 0
        sums[:] = 0
        for i in range(height):
            v = kind(i - (height - 1) / 2)
            row_slopes(depth[n], i, along_u, along_v)
            by_shading[:] = 0
            for c in range(channels):
                for j in range(width):
                    by_shading[j] += grad[n, c, i, j] * albedo[n, c, i, j]
            # from here on along_u and along_v turn into the derivatives by the slopes
            for j in range(width):
                x, y = -focal * along_u[j], -focal * along_v[j]
                z = one + us[j] * along_u[j] + v * along_v[j]
                inverse = one / np.sqrt(x * x + y * y + z * z)
                x, y, z = x * inverse, y * inverse, z * inverse
                facing = x * light_x + y * light_y + z * light_z
                lit = facing if facing > 0 else zero
                shading[j] = ambient + diffuse * lit
                by_cosine = by_shading[j] * diffuse if facing > 0 else zero
                sums[0, j] += by_shading[j]
                sums[1, j] += by_shading[j] * lit
                sums[2, j] += by_cosine * x
                sums[3, j] += by_cosine * y
                sums[4, j] += by_cosine * z
                by_cosine *= inverse
                by_z = by_cosine * (light_z - z * facing)
                along_u[j] = us[j] * by_z - focal * by_cosine * (light_x - x * facing)
                along_v[j] = v * by_z - focal * by_cosine * (light_y - y * facing)
            for c in range(channels):
                for j in range(width):
                    grad_albedo[n, c, i, j] = grad[n, c, i, j] * shading[j]
            row, out = depth[n, i], grad_depth[n, i]
            for j in range(1, width - 1):
                total = row[j + 1] + row[j - 1]
                along_u[j] = two * along_u[j] / (total * total)
            for j in range(1, width - 1):
                out[j + 1] += along_u[j] * row[j - 1]
            for j in range(1, width - 1):
                out[j - 1] -= along_u[j] * row[j + 1]
            last = width - 1
            out[0] -= along_u[0] / row[1]
            out[1] += along_u[0] * row[0] / (row[1] * row[1])
            out[last] += along_u[last] / row[last - 1]
            out[last - 1] -= along_u[last] * row[last] / (row[last - 1] * row[last - 1])
            above, below, count_above, count_below = neighbours(depth[n], i)
            out_above, out_below, _, _ = neighbours(grad_depth[n], i)
            for j in range(width):
                total = below[j] * count_below + above[j] * count_above
                share = (count_above + count_below) * along_v[j] / (total * total)
                out_below[j] += share * above[j]
                out_above[j] -= share * below[j]
        for k in range(5):
            grad_lamp[n, k] = sums[k].astype(np.float64).sum()
