"""Inner loops of the bilinear look-up for Numba; importing this module imports Numba."""

from typing import no_type_check

from derender.render.numba_threads import kernel


@kernel
@no_type_check
def forward(image, uv, mask, colour, start, stop):
    """Write the image's value at each (u, v), 0 where the mask is 0."""
    channels, height, width = image.shape[1], image.shape[2], image.shape[3]
    for n in range(start, stop):
        for q in range(mask.shape[1]):
            for p in range(mask.shape[2]):
                if not mask[n, q, p] > 0:
                    for c in range(channels):
                        colour[n, c, q, p] = 0
                    continue
                u, v = uv[n, q, p, 0], uv[n, q, p, 1]
                # Coordinates are clipped before they become integers: a NaN must not become an address.
                j = int(min(u, width - 2)) if u > 0 else 0
                i = int(min(v, height - 2)) if v > 0 else 0
                across, down = u - j, v - i
                for c in range(channels):
                    upper = image[n, c, i, j] * (1 - across) + image[n, c, i, j + 1] * across
                    lower = image[n, c, i + 1, j] * (1 - across) + image[n, c, i + 1, j + 1] * across
                    colour[n, c, q, p] = upper * (1 - down) + lower * down


@kernel
@no_type_check
def backward(grad, image, uv, mask, grad_image, grad_uv, start, stop):
    """Write the derivatives with respect to the image and the coordinates (overwrites both outputs)."""
    channels, height, width = image.shape[1], image.shape[2], image.shape[3]
    for n in range(start, stop):
        grad_image[n] = 0
        for q in range(mask.shape[1]):
            for p in range(mask.shape[2]):
                grad_uv[n, q, p, 0] = 0
                grad_uv[n, q, p, 1] = 0
                if not mask[n, q, p] > 0:
                    continue
                u, v = uv[n, q, p, 0], uv[n, q, p, 1]
                j = int(min(u, width - 2)) if u > 0 else 0
                i = int(min(v, height - 2)) if v > 0 else 0
                across, down = u - j, v - i
                grad_u, grad_v = across * 0, down * 0
                for c in range(channels):
                    g = grad[n, c, q, p]
                    a, b = image[n, c, i, j], image[n, c, i, j + 1]
                    d, e = image[n, c, i + 1, j], image[n, c, i + 1, j + 1]
                    grad_u += g * ((b - a) * (1 - down) + (e - d) * down)
                    grad_v += g * ((d - a) * (1 - across) + (e - b) * across)
                    grad_image[n, c, i, j] += g * (1 - across) * (1 - down)
                    grad_image[n, c, i, j + 1] += g * across * (1 - down)
                    grad_image[n, c, i + 1, j] += g * (1 - across) * down
                    grad_image[n, c, i + 1, j + 1] += g * across * down
                grad_uv[n, q, p, 0] = grad_u
                grad_uv[n, q, p, 1] = grad_v
