"""The rasteriser on the CPU through Numba, as a torch operator with an analytic derivative.

Registered with torch.library, so that ``torch.compile`` sees one opaque operator. The kernels live in
``numba_kernels.py`` and are imported, and compiled or read from the cache, on the first call.
"""

import torch
from torch import Tensor

from derender.render.rasterize.operator import connect, empty_outputs


def rasterize(vertices: Tensor, focal_px: float) -> tuple[Tensor, Tensor, Tensor]:
    """uv (N, H, W, 2), depth (N, H, W) and the visible triangle (N, H, W), -1 where there is none."""
    return _forward(vertices, focal_px)


@torch.library.custom_op("derender::rasterize_numba", mutates_args=(), device_types="cpu")
def _forward(vertices: Tensor, focal_px: float) -> tuple[Tensor, Tensor, Tensor]:
    from derender.render.numba_threads import array, over_images
    from derender.render.rasterize import numba_kernels

    outputs = uv, depth, triangle = empty_outputs(vertices)
    points, count = array(vertices), len(vertices)
    over_images(numba_kernels.choose, count, points, focal_px, array(triangle))
    over_images(numba_kernels.intersect, count, points, focal_px, array(triangle), array(uv), array(depth))
    return outputs


@torch.library.custom_op("derender::rasterize_numba_backward", mutates_args=(), device_types="cpu")
def _backward(
    grad_uv: Tensor, grad_depth: Tensor, vertices: Tensor, triangle: Tensor, focal_px: float
) -> Tensor:
    from derender.render.numba_threads import array, over_images
    from derender.render.rasterize import numba_kernels

    grad_vertices = vertices.new_empty(vertices.shape)
    inputs = (array(grad_uv), array(grad_depth), array(vertices), focal_px, array(triangle))
    over_images(numba_kernels.intersect_backward, len(vertices), *inputs, array(grad_vertices))
    return grad_vertices


connect(_forward, _backward)
