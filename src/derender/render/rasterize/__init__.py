"""Rasterise a depth map's grid mesh: for each pixel, which canonical pixel coordinates it shows, and how far.

The mesh has two triangles a cell; vertex (v, u) of the grid carries its own pixel coordinates. Which triangle
a pixel shows is decided in float64, identically in all three implementations (``choose``):
* a triangle takes part if all its vertices have z > NEAR_Z and twice its area exceeds MIN_TWICE_AREA_PX2;
  both faces are seen;
* it covers a pixel if the three barycentric weights are at least -EDGE_TOLERANCE (edges are inclusive, and
  rounding cannot open a seam or a border);
* the nearest wins; of those within TIE_TOLERANCE (relative, in inverse depth) of the nearest, the first wins.

With the winner fixed, uv and depth are differentiable functions of its vertices: the point where the pixel's
ray meets the triangle's plane. Nothing flows at occlusion edges. Rendering does both in one pass (warping).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from derender.render.backends import chosen_backend
from derender.render.rasterize.reference import NO_TRIANGLE, intersect, project, visible_triangles
from derender.render.triton_launch import TRIANGLES_PER_PROGRAM, launch


@dataclass(frozen=True)
class Fragments:
    """What each pixel shows.

    Attributes:
        uv: (N, H, W, 2) canonical pixel coordinates, u right and v down; 0 where nothing is seen.
        depth: (N, H, W) z of the visible surface in the camera frame; 0 where nothing is seen.
        mask: (N, H, W) 1 where a triangle is seen, else 0.
    """

    uv: Float[Tensor, "n h w 2"]
    depth: Float[Tensor, "n h w"]
    mask: Float[Tensor, "n h w"]


def rasterize(vertices: Float[Tensor, "n h w 3"], focal_px: float, backend: str = "auto") -> Fragments:
    """Rasterise the grid mesh with these vertices (camera frame) into an image of the grid's own size."""
    height, width = vertices.shape[1:3]
    if height < 2 or width < 2:
        raise ValueError(f"a grid mesh needs at least 2x2 vertices, got {height}x{width}")
    if not focal_px > 0:
        raise ValueError(f"the focal length must be positive, got {focal_px} pixels")
    choose = CHOOSE[chosen_backend(vertices.device, backend)]
    triangle = choose(project(vertices.detach().double(), focal_px))
    uv, depth = intersect(vertices, triangle, focal_px)
    return Fragments(uv, depth, (triangle >= 0).to(vertices.dtype))


def choose_numba(screen: Tensor) -> Tensor:
    """Index of the visible triangle (N, H, W), -1 where there is none, from `reference.project`'s result."""
    from derender.render.numba_threads import array, over_images
    from derender.render.rasterize import numba_kernels

    triangle = torch.empty(screen.shape[1:], dtype=torch.int32)
    over_images(numba_kernels.choose, screen.shape[1], array(screen), array(triangle))
    return triangle


def mark_triangles(screen: Sequence[Tensor]) -> Tensor:
    """The same on a CUDA device, from u, v and inverse depth; NO_TRIANGLE, for its reader, where is none."""
    from derender.render.rasterize import triton_kernels

    _, height, width = screen[0].shape
    nearest = torch.zeros_like(screen[0])
    first = torch.full_like(nearest, NO_TRIANGLE, dtype=torch.int32)
    for second in (False, True):
        launch(
            triton_kernels.choose, first, 2 * (height - 1) * (width - 1),
            *screen, nearest.view(torch.int64), nearest, first, height, width,
            lanes=TRIANGLES_PER_PROGRAM, SECOND=second,
        )  # fmt: skip
    return first


def choose_triton(screen: Tensor) -> Tensor:
    triangle = mark_triangles(screen.unbind())
    return torch.where(triangle == NO_TRIANGLE, -1, triangle)


CHOOSE = {"reference": visible_triangles, "numba": choose_numba, "triton": choose_triton}
