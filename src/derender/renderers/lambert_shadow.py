"""`lambert-shadow`: Lambertian light that the surface itself keeps off, with a soft edge.

Each point's ray is marched towards the light over the depth map, in steps that grow from one pixel. Its
clearance at a step is how far the surface lies behind it, over the distance gone. The smallest clearance
decides: lit where it is positive, dark below -tan(softness), smooth between. So a surface that bulges
everywhere is lit as by ``lambert``, and light and depth get gradients at the edges of shadows. Leaves out
occluders that the depth map does not hold: those outside the image, and what lies behind the surface.
"""

import math
from functools import partial

import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from derender.render import chosen_backend
from derender.renderers.renderer import Maps, Renderer
from derender.scene import Scene
from derender.scene.camera import focal_px
from derender.scene.light import light_direction

Places = tuple[Int64[Tensor, " m"], ...]  # image, row and column of some pixels
_LEAST_SLANT = 1e-4  # of the light against the viewing axis; nearer to it nothing is in shadow


def lambert_shadow(softness_deg: float = 5.0) -> Renderer:
    """Ambient + diffuse * visible * max(0, n.l); ``softness_deg``, 0.1..45: width of a shadow's edge."""
    if not 0.1 <= softness_deg <= 45:
        raise ValueError(f"renderer 'lambert-shadow': softness_deg must lie in 0.1..45, got {softness_deg:g}")
    visibility = partial(_visibility, softness_deg)
    return Renderer("lambert-shadow", visibility=visibility, maps={"cast shadow": visibility})


def _visibility(softness_deg: float, scene: Scene, fov_deg: float) -> Tensor:
    return visible(scene.depth, scene.light, fov_deg, softness_deg)


def visible(depth: Maps, light: Float[Tensor, "n 4"], fov_deg: float, softness_deg: float = 5.0) -> Maps:
    """The share of the directional light that reaches each point, 0..1, with gradients to depth and light."""
    towards = -light_direction(light.to(depth.dtype))
    with torch.no_grad():
        if chosen_backend(depth.device) == "numba":
            from derender.renderers.shadow_numba import lowest_step as search
        else:
            search = _lowest_step
        step = search(depth, towards, focal_px(depth.shape[2], fov_deg))
    places = step.nonzero(as_tuple=True)  # usually few
    result = clearance(depth, towards, places, step[places], focal_px(depth.shape[2], fov_deg))
    share = (1 + result / math.tan(math.radians(softness_deg))).clamp(0, 1)
    return torch.ones_like(depth).index_put(places, share * share * (3 - 2 * share))


def clearance(
    depth: Maps, towards: Float[Tensor, "n 3"], places: Places,
    step: Int32[Tensor, " m"] | Float[Tensor, " m"], focal: float,
) -> Float[Tensor, " m"]:  # fmt: skip
    """How far some pixels' rays run in front of the surface after so many steps, over the distance gone.

    Step k lies k + k^2 / 12 pixels along the ray. Outside the image it is 1: nothing is in the way.
    """
    (n, i, j), (height, width) = places, depth.shape[1:]
    gone, nearer, u, v = _along(towards, places, step * (1 + step / 12), (height, width), focal)
    inside = (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
    left, top = (at.detach().long().clamp(0, most - 2) for at, most in ((u, width), (v, height)))
    across, down, depths = u - left, v - top, depth.flatten()
    here, corner = (n * height + i) * width + j, (n * height + top) * width + left
    corners = torch.cat([here, corner, corner + 1, corner + width, corner + width + 1])
    own, *four = depths.gather(0, corners).chunk(5)
    above, below = torch.lerp(four[0], four[1], across), torch.lerp(four[2], four[3], across)
    return torch.where(inside, (torch.lerp(above, below, down) * nearer - own) / (gone * own), 1.0)


def _along(
    towards: Float[Tensor, "n 3"], places: Places, pixels: Tensor, size: tuple[int, int], focal: float
) -> tuple[Tensor, ...]:
    """Where some pixels' rays are after so many pixels of the image.

    The distance gone over the depth there; the depth at the start over that there; column and row.
    """
    (n, i, j), (height, width) = places, size
    x, y, z = towards[n].unbind(1)
    right, down = focal * x - (j - (width - 1) / 2) * z, focal * y - (i - (height - 1) / 2) * z
    gone = pixels / torch.hypot(right, down).clamp(min=_LEAST_SLANT * focal)
    return gone, 1 - gone * z, j + gone * right, i + gone * down


def _lowest_step(depth: Maps, towards: Float[Tensor, "n 3"], focal: float) -> Int32[Tensor, "n h w"]:
    """The step at which each ray runs deepest below the surface for its distance; 0 if it never does."""
    step, lowest = torch.zeros_like(depth, dtype=torch.int32), torch.zeros_like(depth)
    nearest, size = depth.amin(dim=(1, 2)), (depth.shape[1], depth.shape[2])
    places = torch.ones_like(step).nonzero(as_tuple=True)
    for number in range(1, sum(size)):
        numbers = torch.full(places[0].shape, number, dtype=torch.int32, device=depth.device)
        nearer = _along(towards, places, numbers * (1 + numbers / 12), size, focal)[1]
        under = depth[places] > nearest[places[0]] * nearer
        places, numbers = tuple(axis[under] for axis in places), numbers[under]
        if not len(numbers):
            break
        result = clearance(depth, towards, places, numbers, focal)
        lower = result < lowest[places]
        lowest[places] = torch.where(lower, result, lowest[places])
        step[places] = torch.where(lower, number, step[places])
    return step
