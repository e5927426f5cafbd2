"""Show a canonical image, painted on the surface of a depth map, to a camera.

The surface's grid mesh is moved, rasterised (``rasterize``), and its colours looked up (``sample``).
`reference` composes the definitions of those, on any device, with where the surface lands in float64. Numba
and Triton do it all in one pass over the image, storing neither the moved points nor the canonical
coordinates. They give the same image, but for rounding, and the same gradients.

Forward repeats bit for bit in every run. So does backward on any number of CPU threads, and on a GPU with
torch's deterministic algorithms. ``grid_sample`` is not used: normalising coordinates to -1..1 and back costs
the identity camera its exactness.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from derender.render.backends import chosen_backend, operators
from derender.render.rasterize import mark_triangles, rasterize
from derender.render.triton_launch import float64_bits, launch, programs_per_image, scattered_sums
from derender.scene.camera import focal_px, motion, unproject


def warp(
    image: Float[Tensor, "n c h w"], depth: Float[Tensor, "n h w"], camera: Float[Tensor, "n 6"],
    fov_deg: float, backend: str = "auto",
) -> tuple[Float[Tensor, "n c h w"], Float[Tensor, "n h w"], Float[Tensor, "n h w"]]:  # fmt: skip
    """Image, depth and mask as the camera sees them; 0 where nothing is seen."""
    rotation, offset = motion(camera.double())
    chosen = chosen_backend(depth.device, backend, depth.numel())
    if chosen == "reference":
        return reference(image, depth, rotation, offset, fov_deg)
    return FORWARD[chosen](image, depth, rotation, offset, focal_px(depth.shape[2], fov_deg))[:3]


def reference(
    image: Tensor, depth: Tensor, rotation: Tensor, offset: Tensor, fov_deg: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Image (N, C, H, W), depth and mask (N, H, W) of a surface moved by rotation and offset (float64)."""
    points = unproject(depth.double(), fov_deg)
    moved = torch.baddbmm(offset[:, None], points.flatten(1, 2), rotation.transpose(1, 2))
    seen = rasterize(moved.view(points.shape), focal_px(depth.shape[2], fov_deg), "reference")
    uv, mask = seen.uv.to(image.dtype), seen.mask.to(image.dtype)
    return sample(image, uv, mask), seen.depth.to(image.dtype), mask


def sample(image: Tensor, uv: Tensor, mask: Tensor) -> Tensor:
    """An image (N, C, H, W) at pixel coordinates (N, H2, W2, 2), bilinear; 0, no gradient where mask is 0."""
    count, channels, height, width = image.shape
    uv = torch.where(mask[..., None] > 0, uv, 0)
    # beyond the border, which `rasterize` may exceed by its edge tolerance, the border cell is continued
    left = uv[..., 0].detach().floor().clamp(0, width - 2)
    top = uv[..., 1].detach().floor().clamp(0, height - 2)
    across, down = (uv[..., 0] - left)[:, None], (uv[..., 1] - top)[:, None]
    corner = (top * width + left).long().flatten(1)[:, None].expand(-1, channels, -1)

    def look_up(step: int) -> Tensor:
        return image.flatten(2).gather(2, corner + step).view(count, channels, *mask.shape[1:])

    upper = look_up(0) * (1 - across) + look_up(1) * across
    lower = look_up(width) * (1 - across) + look_up(width + 1) * across
    return torch.where(mask[:, None] > 0, upper * (1 - down) + lower * down, 0)


def _room(image: Tensor, depth: Tensor, rotation: Tensor, offset: Tensor) -> tuple[Tensor, ...]:
    """Empty image, depth, mask and visible triangle."""
    maps = [depth.new_empty(depth.shape) for _ in range(2)]
    return image.new_empty(image.shape), *maps, depth.new_empty(depth.shape, dtype=torch.int32)


def _triton(*values: Any) -> tuple[Tensor, ...]:
    from derender.render.warping import triton_kernels

    *tensors, focal = values
    outputs = _room(*tensors)[:3]
    image, depth, *motion = (value.contiguous() for value in tensors)
    _, channels, height, width = image.shape
    bits, pixels = float64_bits(focal), height * width
    screen = tuple(torch.empty_like(depth, dtype=torch.float64) for _ in range(3))
    launch(triton_kernels.project_depth, depth, pixels, depth, *motion, *screen, bits, height, width)
    triangle = mark_triangles(screen)
    launch(
        triton_kernels.show, depth, pixels,
        image, depth, *motion, triangle, *outputs, bits, height, width, CHANNELS=channels,
    )  # fmt: skip
    return *outputs, triangle


def _triton_backward(*values: Any) -> tuple[Tensor, ...]:
    from derender.render.warping import triton_kernels

    *tensors, focal = values
    inputs = [value.contiguous() for value in tensors]
    _, _, image, depth, *_ = inputs
    count, channels, height, width = image.shape
    pixels = height * width
    parts = count, programs_per_image(pixels), 3, 4
    grad_motion = torch.empty(parts, dtype=torch.float64, device=image.device)

    def run(mode, units, largest, targets) -> None:
        launch(
            triton_kernels.show_backward, depth, pixels,
            *inputs, grad_motion, *targets, units, largest, float64_bits(focal), height, width,
            CHANNELS=channels, MODE=mode,
        )  # fmt: skip

    shapes = [tuple(image.shape), tuple(depth.shape)]
    grad_image, grad_depth = scattered_sums(run, depth, shapes, [image.dtype, torch.float64])
    motion = grad_motion.sum(1)
    return grad_image, grad_depth.to(depth.dtype), motion[..., :3].contiguous(), motion[..., 3].contiguous()


FORWARD = operators(
    "warp", "warping", ("image", "depth", "rotation", "offset"), _room, 2, _triton, _triton_backward
)  # by backend: image, depth, rotation, offset (float64), focal length to image, depth, mask, triangle
