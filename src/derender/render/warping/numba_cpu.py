"""Warping on the CPU through Numba, as a torch operator with an analytic derivative.

Kernels live in ``numba_kernels.py`` and are imported on the first call. Every run gives the same bits, on any
number of threads.
"""

import torch
from torch import Tensor

from derender.render.warping.operator import connect, empty_gradients, empty_outputs
from derender.scene.camera import focal_px


def warp(
    image: Tensor, depth: Tensor, rotation: Tensor, offset: Tensor, fov_deg: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Picture (N, C, H, W), depth and mask (N, H, W) of a surface moved by rotation and offset (float64)."""
    return _forward(image, depth, rotation, offset, focal_px(depth.shape[2], fov_deg))[:3]


@torch.library.custom_op("derender::warp_numba", mutates_args=(), device_types="cpu")
def _forward(
    image: Tensor, depth: Tensor, rotation: Tensor, offset: Tensor, focal: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    from derender.render.numba_threads import array, over_images
    from derender.render.warping import numba_kernels

    outputs = empty_outputs(image, depth)
    inputs = [array(value) for value in (image, depth, rotation, offset)]
    over_images(numba_kernels.forward, len(image), *inputs, focal, *(array(value) for value in outputs))
    return outputs


@torch.library.custom_op("derender::warp_numba_backward", mutates_args=(), device_types="cpu")
def _backward(
    grad_colour: Tensor, grad_depth_seen: Tensor, image: Tensor, depth: Tensor, rotation: Tensor,
    offset: Tensor, triangle: Tensor, focal: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    from derender.render.numba_threads import array, over_images
    from derender.render.warping import numba_kernels

    gradients = empty_gradients(image, depth, rotation, offset)
    inputs = (grad_colour, grad_depth_seen, image, depth, rotation, offset)
    over_images(
        numba_kernels.backward, len(image),
        *(array(value) for value in inputs), focal, array(triangle), *(array(value) for value in gradients),
    )  # fmt: skip
    return gradients


connect(_forward, _backward)
