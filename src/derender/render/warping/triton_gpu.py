"""Warping on a CUDA device through Triton: four kernels forward, one backward, as a torch operator.

Kernels live in ``triton_kernels.py`` and are imported, and compiled, on the first call. Forward is the same
bit for bit in every run; backward too where torch is told to use deterministic algorithms.
"""

import torch
from torch import Tensor

from derender.render.rasterize.triton_gpu import choose_triangles
from derender.render.scattered_sums import scattered_sums
from derender.render.triton_launch import PIXELS_PER_PROGRAM, float64_bits, launch, programs_per_image
from derender.render.warping.operator import connect, empty_outputs
from derender.scene.camera import focal_px


def warp(
    image: Tensor, depth: Tensor, rotation: Tensor, offset: Tensor, fov_deg: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Picture (N, C, H, W), depth and mask (N, H, W) of a surface moved by rotation and offset (float64)."""
    return _forward(image, depth, rotation, offset, focal_px(depth.shape[2], fov_deg))[:3]


@torch.library.custom_op("derender::warp_triton", mutates_args=(), device_types=("cuda", "cpu"))
def _forward(
    image: Tensor, depth: Tensor, rotation: Tensor, offset: Tensor, focal: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    from derender.render.warping import triton_kernels

    outputs = empty_outputs(image, depth)[:3]
    image, depth, rotation, offset = (value.contiguous() for value in (image, depth, rotation, offset))
    _, channels, height, width = image.shape
    bits, pixels = float64_bits(focal), height * width
    motion = rotation, offset
    one = torch.empty(depth.shape, dtype=torch.float64, device=depth.device)
    screen = one, torch.empty_like(one), torch.empty_like(one)
    launch(triton_kernels.project_depth, depth, pixels, depth, *motion, *screen, bits, height, width)
    triangle = choose_triangles(screen)
    launch(
        triton_kernels.show, depth, pixels,
        image, depth, *motion, triangle, *outputs, bits, height, width, CHANNELS=channels,
    )  # fmt: skip
    return *outputs, triangle


@torch.library.custom_op("derender::warp_triton_backward", mutates_args=(), device_types=("cuda", "cpu"))
def _backward(
    grad_colour: Tensor, grad_depth_seen: Tensor, image: Tensor, depth: Tensor, rotation: Tensor,
    offset: Tensor, triangle: Tensor, focal: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    from derender.render.warping import triton_kernels

    count, channels, height, width = image.shape
    pixels = height * width
    inputs = [
        value.contiguous()
        for value in (grad_colour, grad_depth_seen, image, depth, rotation, offset, triangle)
    ]
    parts = count, programs_per_image(pixels, PIXELS_PER_PROGRAM), 3, 4
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


connect(_forward, _backward)
