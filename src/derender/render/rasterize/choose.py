"""The triangle that each pixel shows, by backend (see the package's docstring).

The fast kernels are imported, and compiled, on the first call. Leaves out everything differentiable.
"""

import torch
from torch import Tensor

from derender.render.rasterize.reference import visible_triangles
from derender.render.triton_launch import TRIANGLES_PER_PROGRAM, launch


def choose_numba(screen: Tensor) -> Tensor:
    """Index of the visible triangle (N, H, W), -1 where there is none, from `reference.project`'s result."""
    from derender.render.numba_threads import array, over_images
    from derender.render.rasterize import numba_kernels

    triangle = torch.empty(screen.shape[1:], dtype=torch.int32)
    over_images(numba_kernels.choose, screen.shape[1], array(screen), array(triangle))
    return triangle


def choose_triton(screen: Tensor) -> Tensor:
    """The same on a CUDA device."""
    triangle = mark_triangles(tuple(screen.unbind()))
    return torch.where(triangle == torch.iinfo(torch.int32).max, -1, triangle)


def mark_triangles(screen: tuple[Tensor, ...]) -> Tensor:
    """`choose_triton` on u, v and inverse depth, with the largest int32 where there is no triangle.

    The kernel that reads this map next replaces the mark.
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


CHOOSE = {"reference": visible_triangles, "numba": choose_numba, "triton": choose_triton}
