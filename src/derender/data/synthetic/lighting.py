"""Light on generated meshes beyond one lamp on a matt surface: more lamps, gloss, cast shadows and haze.

The same formulas as ``derender.renderers``, evaluated at each sample of a pixel with the mesh's own normals.
There is Blinn's highlight, and exponential haze by the distance between the nearest and the farthest point
seen. A shadow map for each lamp is drawn by the same z-buffer, four times as fine as the image. A shadow's
edge is averaged over 2 x 2 texels. Leaves out light reflected from one part onto another.
"""

from typing import NamedTuple

import numpy as np
from numpy import ndarray

from derender.render.numba_threads import kernel

EFFECTS = ("shading", "visible", "highlight", "transmission")
"""Maps that are kept of each image, in this order: all diffuse light, share of the first lamp's that
arrives, light of all highlights, share that passes the haze."""
TEXELS = 4  # of a shadow map for each pixel of the image, in each direction
_BIAS, _TEXELS_BIAS = np.float32(0.001), np.float32(1.5)  # a surface shades nothing nearer: scene units,
# and on a slope so many texels more
_ONE, _ZERO = np.float32(1.0), np.float32(0.0)


class Lighting(NamedTuple):
    """The light of one image, in the camera's frame. Without lamps in ``lamps`` beyond the first, gloss, maps
    and haze it is one lamp on a matt surface."""

    ambient: np.float32
    lamps: ndarray  # (L, 4) float32: strength, unit direction in which the light goes
    gloss: ndarray  # (2,) float32: strength and exponent
    haze: ndarray  # (2,) float32: beta, airlight
    across: ndarray  # (L, 2, 3) float32: axes of the shadow maps, per scene unit; drawing fills them
    centre: ndarray  # (3,) float32: what the maps are drawn about; filled as well
    maps: ndarray  # (L, R, R) float32: how near to the lamp the nearest surface is; (0, 0, 0) for no shadows


@kernel
def light_at(lighting, place, normal, span, result):
    """Light on a point with an inward normal: fills ``result`` in the order of ``EFFECTS``.

    ``place`` is column, row, depth, focal length and side of the image; ``span`` the least and greatest depth
    that are seen.
    """
    u, v, z, focal_px, size = place
    middle, (nx, ny, nz) = np.float32(0.5) * np.float32(size - 1), normal
    x, y = (u - middle) * z / focal_px, (v - middle) * z / focal_px
    away = _ONE / np.sqrt(x * x + y * y + z * z)
    result[0], result[1], result[2], result[3] = lighting.ambient, _ONE, _ZERO, _ONE
    if lighting.haze[0] > _ZERO and span[1] > span[0]:
        share = min(max((z - span[0]) / (span[1] - span[0]), _ZERO), _ONE)
        result[3] = np.exp(-lighting.haze[0] * share)
    for number in range(len(lighting.lamps)):
        lamp = lighting.lamps[number]
        cosine = nx * lamp[1] + ny * lamp[2] + nz * lamp[3]
        seen = _ONE if cosine > _ZERO or len(lighting.maps) == 0 else _ZERO
        if cosine > _ZERO and len(lighting.maps):
            seen = _lit(lighting, number, cosine, x, y, z)
        if number == 0:
            result[1] = seen
        if cosine <= _ZERO:
            continue
        result[0] += lamp[0] * seen * cosine
        hx, hy, hz = lamp[1] + x * away, lamp[2] + y * away, lamp[3] + z * away
        shine = (nx * hx + ny * hy + nz * hz) / np.sqrt(hx * hx + hy * hy + hz * hz)
        if shine > _ZERO:
            result[2] += lighting.gloss[0] * lamp[0] * seen * shine ** lighting.gloss[1]


@kernel
def _lit(lighting, number, cosine, x, y, z):
    """The share of the lamp that reaches a point: of the four texels around it, weighted bilinearly."""
    x, y, z = x - lighting.centre[0], y - lighting.centre[1], z - lighting.centre[2]
    across, lamp, size = lighting.across[number], lighting.lamps[number], lighting.maps.shape[1]
    middle = np.float32(0.5) * np.float32(size - 1)
    u = across[0, 0] * x + across[0, 1] * y + across[0, 2] * z + middle
    v = across[1, 0] * x + across[1, 1] * y + across[1, 2] * z + middle
    slope = np.sqrt(max(_ONE - cosine * cosine, _ZERO)) / max(cosine, np.float32(0.1))
    texel = np.sqrt(across[0, 0] ** 2 + across[0, 1] ** 2 + across[0, 2] ** 2)
    near = _ONE - (lamp[1] * x + lamp[2] * y + lamp[3] * z) + _BIAS + _TEXELS_BIAS * slope / texel
    p, q = int(np.floor(u)), int(np.floor(v))
    if p < 0 or q < 0 or p >= size - 1 or q >= size - 1:
        return _ONE
    a, b, total = u - np.float32(p), v - np.float32(q), _ZERO
    for k in range(4):
        right, below = k % 2, k // 2
        if lighting.maps[number, q + below, p + right] <= near:
            total += (a if right else _ONE - a) * (b if below else _ONE - b)
    return total
