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

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from derender.render.backends import chosen_backend
from derender.render.rasterize.choose import CHOOSE
from derender.render.rasterize.reference import intersect, project


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
