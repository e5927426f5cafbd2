"""Bilinear look-up on a CUDA device through Triton, as a torch operator with an analytic derivative.

Kernels live in ``triton_kernels.py`` and are imported, and compiled, on the first call. The gradient by the
image repeats bit for bit where torch is told to use deterministic algorithms; the rest always does.
"""

import torch
from torch import Tensor

from derender.render.sample.operator import connect, empty_colour
from derender.render.scattered_sums import scattered_sums
from derender.render.triton_launch import launch


def sample(image: Tensor, uv: Tensor, mask: Tensor) -> Tensor:
    """(N, C, H2, W2): the image's value at each (u, v); 0 with no gradient where the mask is 0."""
    return _forward(image, uv, mask)


@torch.library.custom_op("derender::sample_triton", mutates_args=(), device_types=("cuda", "cpu"))
def _forward(image: Tensor, uv: Tensor, mask: Tensor) -> Tensor:
    from derender.render.sample import triton_kernels

    colour = empty_colour(image, mask)
    image, uv, mask = image.contiguous(), uv.contiguous(), mask.contiguous()
    _, channels, height, width = image.shape
    pixels = mask.shape[1] * mask.shape[2]
    launch(
        triton_kernels.forward, image, pixels, image, uv, mask, colour, height, width, pixels,
        CHANNELS=channels,
    )  # fmt: skip
    return colour


@torch.library.custom_op("derender::sample_triton_backward", mutates_args=(), device_types=("cuda", "cpu"))
def _backward(grad: Tensor, image: Tensor, uv: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    from derender.render.sample import triton_kernels

    _, channels, height, width = image.shape
    pixels = mask.shape[1] * mask.shape[2]
    inputs = [value.contiguous() for value in (grad, image, uv, mask)]
    grad_uv = torch.empty(uv.shape, dtype=uv.dtype, device=uv.device)

    def run(mode, units, largest, targets) -> None:
        launch(
            triton_kernels.backward, image, pixels,
            *inputs, grad_uv, *targets, units, largest, height, width, pixels, CHANNELS=channels, MODE=mode,
        )  # fmt: skip

    (grad_image,) = scattered_sums(run, mask, [tuple(image.shape)], [image.dtype])
    return grad_image, grad_uv


connect(_forward, _backward)
