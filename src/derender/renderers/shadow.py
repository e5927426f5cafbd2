"""`lambert-shadow`: Lambertian light that the surface itself keeps off, with a soft edge.

Each point's ray is marched towards the light over the depth map, pixel by pixel. Its clearance at a step is
how far the surface lies behind it, over the distance gone. The smallest clearance decides: lit where it is
positive, dark below -tan(softness), smooth between. So a surface that bulges everywhere is lit as by
``lambert``, and light and depth get gradients at the edges of shadows. Leaves out occluders that the depth
map does not hold: those outside the image, and what lies behind the surface.
"""

import math

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn.functional import grid_sample

from derender.render import chosen_backend
from derender.renderers.renderer import Renderer
from derender.scene import Scene
from derender.scene.camera import focal_px, unproject
from derender.scene.light import light_direction

_LEAST_SLANT = 1e-4  # of the light against the viewing axis; nearer to it nothing is in shadow


def lambert_shadow(softness_deg: float = 5.0) -> Renderer:
    """Ambient + diffuse * visible * max(0, n.l); ``softness_deg``, 0.1..45: width of a shadow's edge."""
    if not 0.1 <= softness_deg <= 45:
        raise ValueError(f"renderer 'lambert-shadow': softness_deg must lie in 0.1..45, got {softness_deg:g}")

    def visibility(scene: Scene, fov_deg: float) -> Tensor:
        return visible(scene.depth, scene.light, fov_deg, softness_deg)

    return Renderer("lambert-shadow", visibility=visibility, maps={"cast shadow": visibility})


def visible(
    depth: Float[Tensor, "n h w"], light: Float[Tensor, "n 4"], fov_deg: float, softness_deg: float = 5.0,
    backend: str = "auto",
) -> Float[Tensor, "n h w"]:  # fmt: skip
    """The share of the directional light that reaches each point, 0..1, with gradients to depth and light."""
    towards = -light_direction(light.to(depth.dtype))
    with torch.no_grad():
        if chosen_backend(depth.device, backend) == "numba":
            from derender.renderers.shadow_numba import lowest_step

            step = lowest_step(depth, towards, fov_deg)
        else:
            step = _lowest_step(depth, towards, fov_deg)
    share = 1 + clearance(depth, towards, step, fov_deg) / math.tan(math.radians(softness_deg))
    share = share.clamp(0, 1)
    return share * share * (3 - 2 * share)


def clearance(
    depth: Float[Tensor, "n h w"], towards: Float[Tensor, "n 3"], step: Int64[Tensor, "n h w"], fov_deg: float
) -> Float[Tensor, "n h w"]:
    """How far each ray runs in front of the surface after so many steps, over the distance gone.

    At step 0, and outside the image, it is 1: nothing is in the way.
    """
    height, width = depth.shape[1:]
    focal, points = focal_px(width, fov_deg), unproject(depth, fov_deg)
    gone = step * step_length(depth, towards, focal)
    x, y, z = (points[..., axis] + gone * towards[:, axis, None, None] for axis in range(3))
    place = torch.stack([x / z * (2 * focal / (width - 1)), y / z * (2 * focal / (height - 1))], dim=-1)
    behind = grid_sample(depth[:, None], place, align_corners=True, padding_mode="border")[:, 0] - z
    counts = (step > 0) & (place.detach().abs() <= 1).all(dim=-1)
    return torch.where(counts, behind / torch.where(step > 0, gone, 1.0), 1.0)


def step_length(depth: Tensor, towards: Float[Tensor, "n 3"], focal: float) -> Float[Tensor, "n h w"]:
    """The distance along each ray that moves it by about one pixel."""
    slant = towards[:, :2].norm(dim=1).clamp(min=_LEAST_SLANT)
    return depth / (focal * slant[:, None, None])


def _lowest_step(depth: Tensor, towards: Tensor, fov_deg: float) -> Int64[Tensor, "n h w"]:
    """The step of the smallest clearance; 0 where the ray leaves the range of depths free."""
    step = torch.zeros_like(depth, dtype=torch.int64)
    lowest = torch.ones_like(depth)
    nearest = depth.amin(dim=(1, 2), keepdim=True)
    length = step_length(depth, towards, focal_px(depth.shape[2], fov_deg))
    for number in range(1, sum(depth.shape[1:])):
        above = depth + number * length * towards[:, 2, None, None] > nearest
        if number % 4 == 1 and not bool(above.any()):
            break
        found = clearance(depth, towards, torch.full_like(step, number), fov_deg)
        lower = above & (found < lowest)
        lowest, step = torch.where(lower, found, lowest), torch.where(lower, number, step)
    return step
