"""Scene to image: shade the canonical view, move its surface in front of the camera, look colours up there.

image(p) = canonical image at the canonical coordinates that pixel p sees. The canonical image is albedo times
Lambertian shading with the light in the canonical frame. Leaves out cast shadows, speculars, clipping at 1
and gradients at occlusion edges. Shading is computed in float32 at least, under any autocast. Where the
surface lands is computed in float64, so that the identity camera gives the canonical image bit for bit. This
is the only door: everything else in this folder is how (`rasterize.rasterize`: coordinates without colours).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample

from derender.render import shading, warping
from derender.render.backends import available_backends, chosen_backend
from derender.scene.camera import constant, project, to_camera, unproject
from derender.scene.scene import Scene

__all__ = [
    "Rendering", "available_backends", "chosen_backend", "render", "render_scene", "shade", "unwarp", "warp",
]  # fmt: skip


@dataclass(frozen=True)
class Rendering:
    """Images of a batch of scenes.

    Attributes:
        image: (N, C, H, W) colours from 0 on, not clipped at 1; 0 where nothing is seen. ``render``: C = 3.
        depth: (N, H, W) z of the visible surface in the camera frame; 0 where nothing is seen.
        mask: (N, H, W) 1 where the surface is seen, else 0.
    """

    image: Float[Tensor, "n c h w"]
    depth: Float[Tensor, "n h w"]
    mask: Float[Tensor, "n h w"]


def render(
    depth: Tensor,  # (N, H, W), positive
    albedo: Tensor,  # (N, 3, H, W), 0..1
    light: Tensor,  # (N, 4) ambient, diffuse, pitch, yaw
    camera: Tensor,  # (N, 6) rotation and translation along x, y, z
    fov_deg: float = 10.0,
    backend: str = "auto",
) -> Rendering:
    """Render a batch of canonical surfaces; gradients reach all four inputs (conventions as in ``Scene``)."""
    return warp(shade(depth, albedo, light, fov_deg, backend), depth, camera, fov_deg, backend)


def render_scene(scene: Scene, fov_deg: float = 10.0, backend: str = "auto") -> Rendering:
    """Render a batch of scenes; parameters of further factors are left to their own renderers."""
    return render(scene.depth, scene.albedo, scene.light, scene.camera, fov_deg, backend)


def shade(
    depth: Tensor, albedo: Tensor, light: Tensor, fov_deg: float = 10.0, backend: str = "auto"
) -> Float[Tensor, "n 3 h w"]:
    """The canonical image: albedo times shading, before any camera. Shade once, warp to many cameras."""
    depth, albedo, light = _checked(depth, albedo=(albedo, 3), light=(light, 4))
    with torch.autocast(depth.device.type, enabled=False):
        return shading.shade(depth, albedo, light, fov_deg, backend)


def warp(
    image: Tensor, depth: Tensor, camera: Tensor, fov_deg: float = 10.0, backend: str = "auto"
) -> Rendering:
    """Show a canonical image (N, C, H, W), painted on the surface ``depth``, to another camera."""
    channels = image.shape[1] if image.dim() == 4 else 3
    depth, image, camera = _checked(depth, image=(image, channels), camera=(camera, 6))
    with torch.autocast(depth.device.type, enabled=False):
        return Rendering(*warping.warp(image, depth, camera, fov_deg, backend))


def unwarp(
    image: Float[Tensor, "n c h w"], depth: Float[Tensor, "n h w"], camera: Float[Tensor, "n 6"],
    fov_deg: float = 10.0,
) -> Float[Tensor, "n c h w"]:  # fmt: skip
    """What each canonical pixel shows in an image that ``camera`` took of its surface: undoes `warp`.

    A point that something hides takes the colour in front of it, one outside the image that of its border.
    Conventions as in `render`; the image may have another size than ``depth``: outermost pixels coincide.
    """
    height, width = depth.shape[-2:]
    place = project(to_camera(unproject(depth, fov_deg), camera), height, width, fov_deg)
    grid = place * 2 / constant((width - 1.0, height - 1.0), place) - 1
    return grid_sample(image, grid, padding_mode="border", align_corners=True)


def _checked(depth: Tensor, **others: tuple[Tensor, int]) -> list[Tensor]:
    """The tensors in float32 or float64, or an error that names the one that does not fit ``depth``."""
    if depth.dim() != 3:
        raise ValueError(f"render: depth must have shape (N, H, W), got {tuple(depth.shape)}")
    count, *size = depth.shape
    if min(size) < 2:
        raise ValueError(f"render: depth maps need at least 2x2 pixels, got {size[0]}x{size[1]}")
    values = {"depth": depth} | {name: value for name, (value, _) in others.items()}
    for name, value in values.items():
        if not value.is_floating_point():
            raise ValueError(f"render: {name} must be floating point, got {value.dtype}; use .float()")
        vector = name in ("light", "camera")  # of so many numbers; the others are so many maps
        shape = (count, *(() if name == "depth" else others[name][1:]), *(() if vector else size))
        if tuple(value.shape) != shape:
            raise ValueError(f"render: {name} must have shape {shape} to fit depth, got {tuple(value.shape)}")
        if value.dtype in (torch.float16, torch.bfloat16):
            values[name] = value.float()
    for what in ("dtype", "device"):
        kinds = [getattr(value, what) for value in values.values()]
        if any(kind != kinds[0] for kind in kinds):
            result = ", ".join(f"{name} {kind}" for name, kind in zip(values, kinds, strict=True))
            raise ValueError(f"render: inputs must all have one {what}, got {result}")
    return list(values.values())
