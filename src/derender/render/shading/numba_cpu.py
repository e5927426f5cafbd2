"""Shading on the CPU through Numba, as a torch operator with an analytic derivative.

Kernels live in ``numba_kernels.py`` and are imported on the first call.
"""

import torch
from torch import Tensor


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


@_forward.register_fake
def _(depth: Tensor, albedo: Tensor, lamp: Tensor, focal_px: float) -> Tensor:
    return albedo.new_empty(albedo.shape)


@torch.library.custom_op("derender::shade_numba_backward", mutates_args=(), device_types="cpu")
def _backward(
    grad: Tensor, depth: Tensor, albedo: Tensor, lamp: Tensor, focal_px: float
) -> tuple[Tensor, Tensor, Tensor]:
    from derender.render.numba_threads import array, over_images
    from derender.render.shading import numba_kernels

    gradients = _empty_gradients(depth, albedo, lamp)
    inputs = [array(value) for value in (grad, depth, albedo, lamp)]
    over_images(numba_kernels.backward, len(depth), *inputs, focal_px, *(array(value) for value in gradients))
    return gradients


@_backward.register_fake
def _(
    grad: Tensor, depth: Tensor, albedo: Tensor, lamp: Tensor, focal_px: float
) -> tuple[Tensor, Tensor, Tensor]:
    return _empty_gradients(depth, albedo, lamp)


def _setup_context(ctx, inputs, output) -> None:
    *values, ctx.focal_px = inputs
    ctx.save_for_backward(*values)


def _differentiate(ctx, grad: Tensor) -> tuple[Tensor | None, ...]:
    return *_backward(grad, *ctx.saved_tensors, ctx.focal_px), None


_forward.register_autograd(_differentiate, setup_context=_setup_context)


def _empty_gradients(depth: Tensor, albedo: Tensor, lamp: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    return depth.new_empty(depth.shape), albedo.new_empty(albedo.shape), lamp.new_empty(lamp.shape)
