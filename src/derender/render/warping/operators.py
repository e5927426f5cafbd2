"""Warping as torch operators with an analytic derivative: through Numba on the CPU, Triton on a CUDA device.

Kernels are imported, and compiled, on the first call. Forward is the same bit for bit in every run; backward
too on any number of CPU threads, and on a GPU with torch's deterministic algorithms.
"""

import torch
from torch import Tensor
from torch.library import CustomOpDef  # pyright: ignore[reportPrivateImportUsage]

from derender.render.rasterize.choose import mark_triangles
from derender.render.triton_launch import (
    PIXELS_PER_PROGRAM,
    float64_bits,
    launch,
    programs_per_image,
    scattered_sums,
)


def _empty_outputs(image: Tensor, depth: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Room for the image, depth, mask and visible triangle."""
    return (
        image.new_empty(image.shape),
        depth.new_empty(depth.shape),
        depth.new_empty(depth.shape),
        depth.new_empty(depth.shape, dtype=torch.int32),
    )


def _empty_gradients(
    image: Tensor, depth: Tensor, rotation: Tensor, offset: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Room for the gradient of each."""
    image, depth, rotation, offset = (
        value.new_empty(value.shape) for value in (image, depth, rotation, offset)
    )
    return image, depth, rotation, offset


@torch.library.custom_op("derender::warp_numba", mutates_args=(), device_types="cpu")
def _numba(
    image: Tensor, depth: Tensor, rotation: Tensor, offset: Tensor, focal: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    from derender.render.numba_threads import array, over_images
    from derender.render.warping import numba_kernels

    outputs = _empty_outputs(image, depth)
    inputs = [array(value) for value in (image, depth, rotation, offset)]
    over_images(numba_kernels.forward, len(image), *inputs, focal, *(array(value) for value in outputs))
    return outputs


@torch.library.custom_op("derender::warp_numba_backward", mutates_args=(), device_types="cpu")
def _numba_backward(
    grad_colour: Tensor, grad_depth_seen: Tensor, image: Tensor, depth: Tensor, rotation: Tensor,
    offset: Tensor, triangle: Tensor, focal: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    from derender.render.numba_threads import array, over_images
    from derender.render.warping import numba_kernels

    gradients = _empty_gradients(image, depth, rotation, offset)
    inputs = (grad_colour, grad_depth_seen, image, depth, rotation, offset)
    over_images(
        numba_kernels.backward, len(image),
        *(array(value) for value in inputs), focal, array(triangle), *(array(value) for value in gradients),
    )  # fmt: skip
    return gradients


@torch.library.custom_op("derender::warp_triton", mutates_args=(), device_types=("cuda", "cpu"))
def _triton(
    image: Tensor, depth: Tensor, rotation: Tensor, offset: Tensor, focal: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    from derender.render.warping import triton_kernels

    outputs = _empty_outputs(image, depth)[:3]
    image, depth, rotation, offset = (value.contiguous() for value in (image, depth, rotation, offset))
    _, channels, height, width = image.shape
    bits, pixels = float64_bits(focal), height * width
    motion = rotation, offset
    one = torch.empty(depth.shape, dtype=torch.float64, device=depth.device)
    screen = one, torch.empty_like(one), torch.empty_like(one)
    launch(triton_kernels.project_depth, depth, pixels, depth, *motion, *screen, bits, height, width)
    triangle = mark_triangles(screen)
    launch(
        triton_kernels.show, depth, pixels,
        image, depth, *motion, triangle, *outputs, bits, height, width, CHANNELS=channels,
    )  # fmt: skip
    return *outputs, triangle


@torch.library.custom_op("derender::warp_triton_backward", mutates_args=(), device_types=("cuda", "cpu"))
def _triton_backward(
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


def _connect(forward: CustomOpDef, backward: CustomOpDef) -> None:
    """Make ``backward`` the derivative of ``forward``, and register both's shapes for torch.compile."""

    def outputs(
        image: Tensor, depth: Tensor, rotation: Tensor, offset: Tensor, focal: float
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return _empty_outputs(image, depth)

    def gradients(
        grad_colour: Tensor, grad_depth_seen: Tensor, image: Tensor, depth: Tensor, rotation: Tensor,
        offset: Tensor, triangle: Tensor, focal: float,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
        return _empty_gradients(image, depth, rotation, offset)

    def set_up(ctx, inputs, output) -> None:
        *values, ctx.focal = inputs
        ctx.mark_non_differentiable(output[2], output[3])
        ctx.save_for_backward(*values, output[3])

    def differentiate(ctx, grad_colour: Tensor, grad_depth: Tensor, *_) -> tuple[Tensor | None, ...]:
        return *backward(grad_colour, grad_depth, *ctx.saved_tensors, ctx.focal), None

    forward.register_fake(outputs)
    backward.register_fake(gradients)
    forward.register_autograd(differentiate, setup_context=set_up)


_connect(_numba, _numba_backward)
_connect(_triton, _triton_backward)
FORWARD = {"numba": _numba, "triton": _triton}
"""By backend: image, depth, rotation, offset (float64), focal length to image, depth, mask, triangle."""
