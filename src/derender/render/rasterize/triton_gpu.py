"""The rasteriser on a CUDA device through Triton, as a torch operator with an analytic derivative.

Kernels live in ``triton_kernels.py`` and are imported, and compiled, on the first call. Forward is the same
bit for bit in every run; backward too where torch is told to use deterministic algorithms.
"""

import torch
from torch import Tensor

from derender.render.rasterize.operator import connect, empty_outputs
from derender.render.scattered_sums import scattered_sums
from derender.render.triton_launch import TRIANGLES_PER_PROGRAM, float64_bits, launch


def rasterize(vertices: Tensor, focal_px: float) -> tuple[Tensor, Tensor, Tensor]:
    """uv (N, H, W, 2), depth (N, H, W) and the visible triangle (N, H, W), -1 where there is none."""
    return _forward(vertices, focal_px)


def choose_triangles(screen: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """The visible triangle (N, H, W) int32 from the vertices' u, v and inverse depth (float64).

    Pixels without one hold the largest int32 and not -1: the kernel that reads this map next replaces it.
    """
    from derender.render.rasterize import triton_kernels

    _, height, width = screen[0].shape
    nearest_bits = torch.zeros_like(screen[0], dtype=torch.int64)
    nearest = nearest_bits.view(torch.float64)
    first = torch.full_like(screen[0], torch.iinfo(torch.int32).max, dtype=torch.int32)
    for second in (False, True):
        launch(
            triton_kernels.choose, first, 2 * (height - 1) * (width - 1),
            *screen, nearest_bits, nearest, first, height, width,
            lanes=TRIANGLES_PER_PROGRAM, SECOND=second,
        )  # fmt: skip
    return first


@torch.library.custom_op("derender::rasterize_triton", mutates_args=(), device_types=("cuda", "cpu"))
def _forward(vertices: Tensor, focal_px: float) -> tuple[Tensor, Tensor, Tensor]:
    from derender.render.rasterize import triton_kernels

    vertices = vertices.contiguous()
    _, height, width, _ = vertices.shape
    focal, pixels = float64_bits(focal_px), height * width
    one = torch.empty(vertices.shape[:3], dtype=torch.float64, device=vertices.device)
    screen = one, torch.empty_like(one), torch.empty_like(one)
    launch(triton_kernels.project_vertices, vertices, pixels, vertices, *screen, focal, height, width)
    triangle = choose_triangles(screen)
    uv, depth, _ = empty_outputs(vertices)
    launch(triton_kernels.intersect, vertices, pixels, vertices, triangle, uv, depth, focal, height, width)
    return uv, depth, triangle


@torch.library.custom_op("derender::rasterize_triton_backward", mutates_args=(), device_types=("cuda", "cpu"))
def _backward(
    grad_uv: Tensor, grad_depth: Tensor, vertices: Tensor, triangle: Tensor, focal_px: float
) -> Tensor:
    from derender.render.rasterize import triton_kernels

    _, height, width, _ = vertices.shape
    inputs = [value.contiguous() for value in (grad_uv, grad_depth, vertices, triangle)]

    def run(mode, units, largest, targets) -> None:
        launch(
            triton_kernels.intersect_backward, vertices, height * width,
            *inputs, *targets, units, largest, float64_bits(focal_px), height, width, MODE=mode,
        )  # fmt: skip

    (grad_vertices,) = scattered_sums(run, vertices[..., 0], [tuple(vertices.shape)], [torch.float64])
    return grad_vertices.to(vertices.dtype)


connect(_forward, _backward)
