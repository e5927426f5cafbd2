"""Shading on a CUDA device through Triton, as a torch operator with an analytic derivative.

Kernels live in ``triton_kernels.py`` and are imported, and compiled, on the first call. Every run gives the
same bits, forward and backward.
"""

import torch
from torch import Tensor

from derender.render.shading.operator import connect
from derender.render.triton_launch import PIXELS_PER_PROGRAM, float64_bits, launch, programs_per_image


def shade(depth: Tensor, albedo: Tensor, lamp: Tensor, focal_px: float) -> Tensor:
    """Albedo (N, C, H, W) shaded; ``lamp`` (N, 5) is ambient, diffuse and the light's unit direction."""
    return _forward(depth, albedo, lamp, focal_px)


@torch.library.custom_op("derender::shade_triton", mutates_args=(), device_types=("cuda", "cpu"))
def _forward(depth: Tensor, albedo: Tensor, lamp: Tensor, focal_px: float) -> Tensor:
    from derender.render.shading import triton_kernels

    depth, albedo, lamp = depth.contiguous(), albedo.contiguous(), lamp.contiguous()
    _, channels, height, width = albedo.shape
    image = torch.empty(albedo.shape, dtype=albedo.dtype, device=albedo.device)
    launch(
        triton_kernels.forward, depth, height * width,
        depth, albedo, lamp, image, float64_bits(focal_px), height, width, CHANNELS=channels,
    )  # fmt: skip
    return image


@torch.library.custom_op("derender::shade_triton_backward", mutates_args=(), device_types=("cuda", "cpu"))
def _backward(
    grad: Tensor, depth: Tensor, albedo: Tensor, lamp: Tensor, focal_px: float
) -> tuple[Tensor, Tensor, Tensor]:
    from derender.render.shading import triton_kernels

    grad, depth, albedo, lamp = (value.contiguous() for value in (grad, depth, albedo, lamp))
    count, channels, height, width = albedo.shape
    pixels = height * width
    grad_albedo, grad_depth, grad_slope_u, grad_slope_v = (
        torch.empty_like(value) for value in (albedo, depth, depth, depth)
    )
    grad_lamp = lamp.new_empty(count, programs_per_image(pixels, PIXELS_PER_PROGRAM), 5)
    launch(
        triton_kernels.backward, depth, pixels,
        grad, depth, albedo, lamp, grad_albedo, grad_slope_u, grad_slope_v, grad_lamp,
        float64_bits(focal_px), height, width, CHANNELS=channels,
    )  # fmt: skip
    launch(triton_kernels.gather, depth, pixels, depth, grad_slope_u, grad_slope_v, grad_depth, height, width)
    return grad_depth, grad_albedo, grad_lamp.sum(1)


connect(_forward, _backward)
