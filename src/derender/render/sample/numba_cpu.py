"""Bilinear look-up on the CPU through Numba, as a torch operator with an analytic derivative.

Kernels live in ``numba_kernels.py`` and are imported on the first call.
"""

import torch
from torch import Tensor


def sample(image: Tensor, uv: Tensor, mask: Tensor) -> Tensor:
    """(N, C, H2, W2): the image's value at each (u, v); 0 with no gradient where the mask is 0."""
    return _forward(image, uv, mask)


@torch.library.custom_op("derender::sample_numba", mutates_args=(), device_types="cpu")
def _forward(image: Tensor, uv: Tensor, mask: Tensor) -> Tensor:
    from derender.render.numba_threads import array, over_images
    from derender.render.sample import numba_kernels

    colour = _empty_colour(image, mask)
    over_images(numba_kernels.forward, len(image), array(image), array(uv), array(mask), array(colour))
    return colour


@_forward.register_fake
def _(image: Tensor, uv: Tensor, mask: Tensor) -> Tensor:
    return _empty_colour(image, mask)


@torch.library.custom_op("derender::sample_numba_backward", mutates_args=(), device_types="cpu")
def _backward(grad: Tensor, image: Tensor, uv: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    from derender.render.numba_threads import array, over_images
    from derender.render.sample import numba_kernels

    grad_image, grad_uv = _empty_gradients(image, uv)
    inputs = (array(value) for value in (grad, image, uv, mask))
    over_images(numba_kernels.backward, len(image), *inputs, array(grad_image), array(grad_uv))
    return grad_image, grad_uv


@_backward.register_fake
def _(grad: Tensor, image: Tensor, uv: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    return _empty_gradients(image, uv)


def _setup_context(ctx, inputs, output) -> None:
    ctx.save_for_backward(*inputs)


def _differentiate(ctx, grad: Tensor) -> tuple[Tensor, Tensor, None]:
    return *_backward(grad, *ctx.saved_tensors), None


_forward.register_autograd(_differentiate, setup_context=_setup_context)


def _empty_colour(image: Tensor, mask: Tensor) -> Tensor:
    return image.new_empty((*image.shape[:2], *mask.shape[1:]))


def _empty_gradients(image: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    return image.new_empty(image.shape), uv.new_empty(uv.shape)
