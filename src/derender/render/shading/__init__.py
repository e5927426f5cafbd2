"""Shade the canonical view: albedo times Lambertian shading of the depth map's normals.

The reference composes the scene's own functions, which define what is computed. Numba and Triton go over the
image once forward and twice backward, as torch operators with an analytic derivative, and store no normals.
Fast kernels are imported, and compiled, on the first call. Every run gives the same bits, forward and
backward.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.library import CustomOpDef  # pyright: ignore[reportPrivateImportUsage]

from derender.render.backends import chosen_backend
from derender.render.triton_launch import PIXELS_PER_PROGRAM, float64_bits, launch, programs_per_image
from derender.scene.camera import focal_px
from derender.scene.light import lambert_shading, light_direction
from derender.scene.normals import normals_from_depth


def shade(
    depth: Float[Tensor, "n h w"],
    albedo: Float[Tensor, "n c h w"],
    light: Float[Tensor, "n 4"],
    fov_deg: float,
    backend: str = "auto",
) -> Float[Tensor, "n c h w"]:
    """The canonical image, from 0 on and not clipped at 1."""
    chosen = chosen_backend(depth.device, backend)
    if chosen == "reference":
        return albedo * lambert_shading(normals_from_depth(depth, fov_deg), light)
    lamp = torch.cat((light[:, :2], light_direction(light)), dim=1)
    return FORWARD[chosen](depth, albedo, lamp, focal_px(depth.shape[2], fov_deg))


def _empty_gradients(depth: Tensor, albedo: Tensor, lamp: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Room for the gradient of each."""
    return depth.new_empty(depth.shape), albedo.new_empty(albedo.shape), lamp.new_empty(lamp.shape)


@torch.library.custom_op("derender::shade_numba", mutates_args=(), device_types="cpu")
def _numba(depth: Tensor, albedo: Tensor, lamp: Tensor, focal_px: float) -> Tensor:
    from derender.render.numba_threads import array, over_images
    from derender.render.shading import numba_kernels

    image = albedo.new_empty(albedo.shape)
    inputs = [array(value) for value in (depth, albedo, lamp)]
    over_images(numba_kernels.forward, len(depth), *inputs, focal_px, array(image))
    return image


@torch.library.custom_op("derender::shade_numba_backward", mutates_args=(), device_types="cpu")
def _numba_backward(
    grad: Tensor, depth: Tensor, albedo: Tensor, lamp: Tensor, focal_px: float
) -> tuple[Tensor, Tensor, Tensor]:
    from derender.render.numba_threads import array, over_images
    from derender.render.shading import numba_kernels

    gradients = _empty_gradients(depth, albedo, lamp)
    inputs = [array(value) for value in (grad, depth, albedo, lamp)]
    over_images(numba_kernels.backward, len(depth), *inputs, focal_px, *(array(value) for value in gradients))
    return gradients


@torch.library.custom_op("derender::shade_triton", mutates_args=(), device_types=("cuda", "cpu"))
def _triton(depth: Tensor, albedo: Tensor, lamp: Tensor, focal_px: float) -> Tensor:
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
def _triton_backward(
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


def _connect(forward: CustomOpDef, backward: CustomOpDef) -> None:
    """Make ``backward`` the derivative of ``forward``, and register both's shapes for torch.compile."""

    def output(depth: Tensor, albedo: Tensor, lamp: Tensor, focal_px: float) -> Tensor:
        return albedo.new_empty(albedo.shape)

    def gradients(
        grad: Tensor, depth: Tensor, albedo: Tensor, lamp: Tensor, focal_px: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        return _empty_gradients(depth, albedo, lamp)

    def set_up(ctx, inputs, output) -> None:
        *values, ctx.focal_px = inputs
        ctx.save_for_backward(*values)

    def differentiate(ctx, grad: Tensor) -> tuple[Tensor | None, ...]:
        return *backward(grad, *ctx.saved_tensors, ctx.focal_px), None

    forward.register_fake(output)
    backward.register_fake(gradients)
    forward.register_autograd(differentiate, setup_context=set_up)


_connect(_numba, _numba_backward)
_connect(_triton, _triton_backward)
FORWARD = {"numba": _numba, "triton": _triton}
"""By backend: depth, albedo, lamp (N, 5: ambient, diffuse, the light's unit direction) and focal length."""
