"""Bilinear look-up on the CPU through Numba, as a torch operator with an analytic derivative.

Kernels live in ``numba_kernels.py`` and are imported on the first call.
"""

import torch
from torch import Tensor

from derender.render.sample.operator import connect, empty_colour, empty_gradients


def sample(image: Tensor, uv: Tensor, mask: Tensor) -> Tensor:
    """(N, C, H2, W2): the image's value at each (u, v); 0 with no gradient where the mask is 0."""
    return _forward(image, uv, mask)


@torch.library.custom_op("derender::sample_numba", mutates_args=(), device_types="cpu")
def _forward(image: Tensor, uv: Tensor, mask: Tensor) -> Tensor:
    from derender.render.numba_threads import array, over_images
    from derender.render.sample import numba_kernels

    colour = empty_colour(image, mask)
    over_images(numba_kernels.forward, len(image), array(image), array(uv), array(mask), array(colour))
    return colour


@torch.library.custom_op("derender::sample_numba_backward", mutates_args=(), device_types="cpu")
def _backward(grad: Tensor, image: Tensor, uv: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    from derender.render.numba_threads import array, over_images
    from derender.render.sample import numba_kernels

    grad_image, grad_uv = empty_gradients(image, uv)
    inputs = (array(value) for value in (grad, image, uv, mask))
    over_images(numba_kernels.backward, len(image), *inputs, array(grad_image), array(grad_uv))
    return grad_image, grad_uv


connect(_forward, _backward)
