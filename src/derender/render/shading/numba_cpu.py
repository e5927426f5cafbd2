"""Shading on the CPU through Numba, as a torch operator with an analytic derivative.

Kernels live in ``numba_kernels.py`` and are imported on the first call.
"""

import torch
from torch import Tensor

from derender.render.shading.operator import connect, empty_gradients


def shade(depth: Tensor, albedo: Tensor, lamp: Tensor, focal_px: float) -> Tensor:
    """Albedo (N, C, H, W) shaded; ``lamp`` (N, 5) is ambient, diffuse and the light's unit direction."""
    return _forward(depth, albedo, lamp, focal_px)


@torch.library.custom_op("derender::shade_numba", mutates_args=(), device_types="cpu")
def _forward(depth: Tensor, albedo: Tensor, lamp: Tensor, focal_px: float) -> Tensor:
    from derender.render.numba_threads import array, over_images
    from derender.render.shading import numba_kernels

    image = albedo.new_empty(albedo.shape)
    inputs = [array(value) for value in (depth, albedo, lamp)]
    over_images(numba_kernels.forward, len(depth), *inputs, focal_px, array(image))
    return image


@torch.library.custom_op("derender::shade_numba_backward", mutates_args=(), device_types="cpu")
def _backward(
    grad: Tensor, depth: Tensor, albedo: Tensor, lamp: Tensor, focal_px: float
) -> tuple[Tensor, Tensor, Tensor]:
    from derender.render.numba_threads import array, over_images
    from derender.render.shading import numba_kernels

    gradients = empty_gradients(depth, albedo, lamp)
    inputs = [array(value) for value in (grad, depth, albedo, lamp)]
    over_images(numba_kernels.backward, len(depth), *inputs, focal_px, *(array(value) for value in gradients))
    return gradients


connect(_forward, _backward)
