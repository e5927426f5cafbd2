"""Shade the canonical view: albedo times Lambertian shading of the depth map's normals.

The reference composes the scene's own functions, which define what is computed. Numba and Triton go over the
image once forward and twice backward and store no normals. Every run gives the same bits, forward and
backward.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from derender.render.backends import chosen_backend, operators
from derender.render.triton_launch import float64_bits, launch, programs_per_image
from derender.scene.camera import focal_px
from derender.scene.light import lambert_shading, light_direction
from derender.scene.normals import normals_from_depth


def shade(
    depth: Float[Tensor, "n h w"], albedo: Float[Tensor, "n c h w"], light: Float[Tensor, "n 4"],
    fov_deg: float, backend: str = "auto",
) -> Float[Tensor, "n c h w"]:  # fmt: skip
    """The canonical image, from 0 on and not clipped at 1."""
    chosen = chosen_backend(depth.device, backend, depth.numel())
    if chosen == "reference":
        return albedo * lambert_shading(normals_from_depth(depth, fov_deg), light)
    lamp = torch.cat((light[:, :2], light_direction(light)), dim=1)
    return FORWARD[chosen](depth, albedo, lamp, focal_px(depth.shape[2], fov_deg))


def _room(depth: Tensor, albedo: Tensor, lamp: Tensor) -> tuple[Tensor]:
    return (albedo.new_empty(albedo.shape),)


def _triton(depth: Tensor, albedo: Tensor, lamp: Tensor, focal_px: float) -> Tensor:
    from derender.render.shading import triton_kernels

    depth, albedo, lamp = depth.contiguous(), albedo.contiguous(), lamp.contiguous()
    _, channels, height, width = albedo.shape
    (image,) = _room(depth, albedo, lamp)
    launch(
        triton_kernels.forward, depth, height * width,
        depth, albedo, lamp, image, float64_bits(focal_px), height, width, CHANNELS=channels,
    )  # fmt: skip
    return image


def _triton_backward(
    grad: Tensor, depth: Tensor, albedo: Tensor, lamp: Tensor, focal_px: float
) -> tuple[Tensor, Tensor, Tensor]:
    from derender.render.shading import triton_kernels

    inputs = [value.contiguous() for value in (grad, depth, albedo, lamp)]
    count, channels, height, width = albedo.shape
    grad_albedo, *by_slopes, grad_depth = (torch.empty_like(inputs[place]) for place in (2, 1, 1, 1))
    grad_lamp = lamp.new_empty(count, programs_per_image(height * width), 5)
    launch(
        triton_kernels.backward, depth, height * width,
        *inputs, grad_albedo, *by_slopes, grad_lamp, float64_bits(focal_px), height, width, CHANNELS=channels,
    )  # fmt: skip
    launch(triton_kernels.gather, depth, height * width, inputs[1], *by_slopes, grad_depth, height, width)
    return grad_depth, grad_albedo, grad_lamp.sum(1)


FORWARD = operators("shade", "shading", ("depth", "albedo", "lamp"), _room, 1, _triton, _triton_backward)
"""By backend: depth, albedo, lamp (N, 5: ambient, diffuse, the light's unit direction) and focal length."""
