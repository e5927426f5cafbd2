"""Warping's inner loops for Numba: from depth map and motion to the image; importing this imports Numba.

Where the surface lands and what a pixel shows is float64 arithmetic; colours are computed in the image's own
dtype. The moved points of one image at a time are in scratch memory and stay in the processor's cache.
"""

import numpy as np

from derender.render.numba_threads import kernel
from derender.render.rasterize.numba_kernels import choose_in, project


@kernel
def move(depth, rotation, offset, focal, points):
    """Write one image's surface points in the camera's frame."""
    height, width = depth.shape
    centre_u, centre_v = (width - 1) / 2, (height - 1) / 2
    for i in range(height):
        ray_y = (i - centre_v) / focal
        x0 = rotation[0, 1] * ray_y + rotation[0, 2]
        y0 = rotation[1, 1] * ray_y + rotation[1, 2]
        z0 = rotation[2, 1] * ray_y + rotation[2, 2]
        for j in range(width):
            ray_x, distance = (j - centre_u) / focal, np.float64(depth[i, j])
            points[i, j, 0] = distance * (rotation[0, 0] * ray_x + x0) + offset[0]
            points[i, j, 1] = distance * (rotation[1, 0] * ray_x + y0) + offset[1]
            points[i, j, 2] = distance * (rotation[2, 0] * ray_x + z0) + offset[2]


@kernel
def meet(flat, triangle, width, ray_x, ray_y):
    """Where the ray (ray_x, ray_y, 1) meets a triangle's plane.

    Gives row, column and half of its cell. Then come the places of its vertices, their z, their x and y less
    the ray's, and their weights, not normalised.
    """
    cell, half = np.uint32(triangle) >> 1, np.intp(triangle & 1)
    i, j = np.intp(cell // np.uint32(width - 1)), np.intp(cell % np.uint32(width - 1))
    k0, k1, k2 = i * width + j + half, (i + half) * width + j + 1, (i + 1) * width + j
    z0, z1, z2 = flat[k0, 2], flat[k1, 2], flat[k2, 2]
    x0, y0 = flat[k0, 0] - ray_x * z0, flat[k0, 1] - ray_y * z0
    x1, y1 = flat[k1, 0] - ray_x * z1, flat[k1, 1] - ray_y * z1
    x2, y2 = flat[k2, 0] - ray_x * z2, flat[k2, 1] - ray_y * z2
    w = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
    return (i, j, half), (k0, k1, k2), (z0, z1, z2), (x0, y0, x1, y1, x2, y2), w


@kernel
def corner(coordinate, size):
    """First pixel, along an axis, of the cell that holds a coordinate; the border cells are continued."""
    if not coordinate > 0:
        return 0
    return min(np.intp(coordinate), size - 2)


@kernel
def forward(image, depth, rotation, offset, focal, colour, seen_depth, mask, triangle, start, stop):
    """Write the image, its depth and mask, and the triangle each pixel shows."""
    channels, height, width = image.shape[1], image.shape[2], image.shape[3]
    centre_u, centre_v = (width - 1) / 2, (height - 1) / 2
    pixels, kind = height * width, image.dtype.type
    one, flat_size = kind(1), (channels, pixels)
    points, screen = np.empty((height, width, 3)), np.empty((3, height, width))
    nearest, held = np.empty((height, width)), np.empty((height, width))
    flat = points.reshape((pixels, 3))
    for n in range(start, stop):
        move(depth[n], rotation[n], offset[n], focal, points)
        project(points, focal, screen)
        choose_in(screen, nearest, held, triangle[n])
        canonical, picture = image[n].reshape(flat_size), colour[n].reshape(flat_size)
        distance, covered = seen_depth[n].reshape(pixels), mask[n].reshape(pixels)
        for q in range(height):
            ray_y = (q - centre_v) / focal
            for p in range(width):
                at, index = q * width + p, triangle[n, q, p]
                if index < 0:
                    distance[at] = 0
                    covered[at] = 0
                    for c in range(channels):
                        picture[c, at] = 0
                    continue
                place, _, z, _, w = meet(flat, index, width, (p - centre_u) / focal, ray_y)
                (i, j, half), (w0, w1, w2) = place, w
                scale = 1 / (w0 + w1 + w2)
                distance[at] = (w0 * z[0] + w1 * z[1] + w2 * z[2]) * scale
                covered[at] = 1
                # in the image's dtype, in which the identity camera's coordinates are whole
                u, v = kind(j + (w0 * half + w1) * scale), kind(i + (w1 * half + w2) * scale)
                left, top = corner(u, width), corner(v, height)
                across, down = u - kind(left), v - kind(top)
                a, d = top * width + left, (top + 1) * width + left
                for c in range(channels):
                    upper = canonical[c, a] * (one - across) + canonical[c, a + 1] * across
                    lower = canonical[c, d] * (one - across) + canonical[c, d + 1] * across
                    picture[c, at] = upper * (one - down) + lower * down


@kernel
def backward(
    grad_colour, grad_seen_depth, image, depth, rotation, offset, triangle, focal,
    grad_image, grad_depth, grad_rotation, grad_offset, start, stop,
):  # fmt: skip
    """Write the derivatives by image, depth map and motion (overwrites all four outputs)."""
    channels, height, width = image.shape[1], image.shape[2], image.shape[3]
    centre_u, centre_v = (width - 1) / 2, (height - 1) / 2
    pixels, kind = height * width, image.dtype.type
    one, flat_size = kind(1), (channels, pixels)
    points, by_points = np.empty((height, width, 3)), np.empty((height, width, 3))
    flat, by_flat = points.reshape((pixels, 3)), by_points.reshape((pixels, 3))
    for n in range(start, stop):
        move(depth[n], rotation[n], offset[n], focal, points)
        by_points[:] = 0
        grad_image[n] = 0
        canonical, by_canonical = image[n].reshape(flat_size), grad_image[n].reshape(flat_size)
        by_picture, by_distance = grad_colour[n].reshape(flat_size), grad_seen_depth[n].reshape(pixels)
        for q in range(height):
            ray_y = (q - centre_v) / focal
            for p in range(width):
                at, index = q * width + p, triangle[n, q, p]
                if index < 0:
                    continue
                ray_x = (p - centre_u) / focal
                (i, j, half), k, z, xy, (w0, w1, w2) = meet(flat, index, width, ray_x, ray_y)
                x0, y0, x1, y1, x2, y2 = xy
                scale = 1 / (w0 + w1 + w2)
                b0, b1, b2 = w0 * scale, w1 * scale, w2 * scale
                u, v = kind(j + b0 * half + b1), kind(i + b1 * half + b2)
                left, top = corner(u, width), corner(v, height)
                across, down = u - kind(left), v - kind(top)
                rest_u, rest_v = one - across, one - down
                upper_left, lower_left = top * width + left, (top + 1) * width + left
                gu, gv = kind(0), kind(0)
                for c in range(channels):
                    g = by_picture[c, at]
                    a, b = canonical[c, upper_left], canonical[c, upper_left + 1]
                    d, e = canonical[c, lower_left], canonical[c, lower_left + 1]
                    gu += g * ((b - a) * rest_v + (e - d) * down)
                    gv += g * ((d - a) * rest_u + (e - b) * across)
                    by_canonical[c, upper_left] += g * rest_v * rest_u
                    by_canonical[c, upper_left + 1] += g * rest_v * across
                    by_canonical[c, lower_left] += g * down * rest_u
                    by_canonical[c, lower_left + 1] += g * down * across
                by_u, by_v, gz = np.float64(gu), np.float64(gv), np.float64(by_distance[at])
                # by the barycentric weights b (but for a constant), by the unnormalised w, by the points
                gb0, gb1 = by_u * half + gz * z[0], by_u + by_v * half + gz * z[1]
                gb2 = by_v + gz * z[2]
                mean = b0 * gb0 + b1 * gb1 + b2 * gb2
                gw0, gw1, gw2 = (gb0 - mean) * scale, (gb1 - mean) * scale, (gb2 - mean) * scale
                gx0, gy0 = gw2 * y1 - gw1 * y2, gw1 * x2 - gw2 * x1
                gx1, gy1 = gw0 * y2 - gw2 * y0, gw2 * x0 - gw0 * x2
                gx2, gy2 = gw1 * y0 - gw0 * y1, gw0 * x1 - gw1 * x0
                add(by_flat[k[0]], gx0, gy0, gz * b0 - ray_x * gx0 - ray_y * gy0)
                add(by_flat[k[1]], gx1, gy1, gz * b1 - ray_x * gx1 - ray_y * gy1)
                add(by_flat[k[2]], gx2, gy2, gz * b2 - ray_x * gx2 - ray_y * gy2)
        move_backward(
            by_points, depth[n], rotation[n], focal, grad_depth[n], grad_rotation[n], grad_offset[n]
        )


@kernel
def add(point, x, y, z):
    point[0] += x
    point[1] += y
    point[2] += z


@kernel
def move_backward(by_points, depth, rotation, focal, grad_depth, grad_rotation, grad_offset):
    """Write the derivative of ``move``: of one image's depth map and motion."""
    height, width = depth.shape
    centre_u, centre_v = (width - 1) / 2, (height - 1) / 2
    total = np.zeros((3, 4))
    for i in range(height):
        ray_y = (i - centre_v) / focal
        for k in range(3):
            along, constant = rotation[k, 0], rotation[k, 1] * ray_y + rotation[k, 2]
            by_ray_x, by_ray_z, by_offset = 0.0, 0.0, 0.0
            for j in range(width):
                ray_x, distance, g = (j - centre_u) / focal, np.float64(depth[i, j]), by_points[i, j, k]
                share = g * (along * ray_x + constant)
                grad_depth[i, j] = share if k == 0 else grad_depth[i, j] + share
                by_ray_x += g * distance * ray_x
                by_ray_z += g * distance
                by_offset += g
            total[k, 0] += by_ray_x
            total[k, 1] += by_ray_z * ray_y
            total[k, 2] += by_ray_z
            total[k, 3] += by_offset
    for k in range(3):  # one by one: for arrays Numba compiles a message about their shapes, for seconds
        grad_offset[k] = total[k, 3]
        for axis in range(3):
            grad_rotation[k, axis] = total[k, axis]
