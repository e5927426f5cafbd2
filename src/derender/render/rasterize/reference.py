"""The rasteriser's definition in plain torch: any device, any floating dtype, arithmetic in float64.

``project`` finds where vertices land. ``visible_triangles`` finds, without gradients, the triangle each pixel
shows: every triangle is paired with the pixels of its bounding box, the pairs are tested, and the nearest
kept by scatter reductions. ``intersect`` then computes, differentiably, where the pixel's ray meets that
triangle. Memory is bounded by working through pairs ``PAIRS_AT_ONCE`` at a time. Speed is not an aim.
"""

from collections.abc import Iterator

import torch
from torch import Tensor

# Triangles are skipped that have a vertex at or before the first, a doubled screen area not above the second
# (edge-on, or a point), or a vertex projected farther out than the third (infinite ones, too).
NEAR_Z, MIN_TWICE_AREA_PX2, MAX_COORDINATE_PX = 1e-3, 1e-5, 1e9
EDGE_TOLERANCE = 1e-4  # so far below zero a barycentric weight may be; in pixels, that part of a cell
TIE_TOLERANCE = 1e-6  # inverse depths this close (relative) are equal: the lowest triangle wins
NO_TRIANGLE = torch.iinfo(torch.int32).max  # above every index, where none has been found yet
PAIRS_AT_ONCE = 1 << 20


def project(vertices: Tensor, focal_px: float) -> Tensor:
    """u, v and inverse depth (3, N, H, W) of vertices in float64; inverse depth 0 marks one left out."""
    height, width = vertices.shape[1:3]
    x, y, z = vertices.unbind(-1)
    inverse_z = 1 / z
    u = x * inverse_z * focal_px + (width - 1) / 2
    v = y * inverse_z * focal_px + (height - 1) / 2
    seen = (z > NEAR_Z) & (u.abs() <= MAX_COORDINATE_PX) & (v.abs() <= MAX_COORDINATE_PX)
    return torch.where(seen, torch.stack((u, v, inverse_z)), 0)


def triangle_corners(height: int, width: int, device: torch.device) -> Tensor:
    """Vertex indices (2 (H-1) (W-1), 3): each cell is cut from its top right to its bottom left corner."""
    row, column = torch.arange(height - 1, device=device), torch.arange(width - 1, device=device)
    top_left = (row[:, None] * width + column).ravel()
    upper = torch.stack((top_left, top_left + 1, top_left + width), -1)
    lower = torch.stack((top_left + 1, top_left + width + 1, top_left + width), -1)
    return torch.stack((upper, lower), 1).view(-1, 3)


def visible_triangles(screen: Tensor) -> Tensor:
    """Index of the triangle each pixel shows, (N, H, W), or -1, from ``project``'s result."""
    triangle = torch.full(screen.shape[1:], -1, device=screen.device)
    for n in range(len(triangle)):
        triangle[n] = _visible_triangle(*screen[:, n])
    return triangle


def _visible_triangle(u: Tensor, v: Tensor, inverse_z: Tensor) -> Tensor:
    height, width = u.shape
    corners = triangle_corners(height, width, u.device)
    u, v, inverse_z = (value.ravel()[corners] for value in (u, v, inverse_z))
    area = (u[:, 1] - u[:, 0]) * (v[:, 2] - v[:, 0]) - (u[:, 2] - u[:, 0]) * (v[:, 1] - v[:, 0])
    kept = ((inverse_z != 0).all(-1) & (area.abs() > MIN_TWICE_AREA_PX2)).nonzero()[:, 0]
    u, v, inverse_z, area = u[kept], v[kept], inverse_z[kept], area[kept]

    nearest = u.new_zeros(height * width)
    for _, pixel, inverse_depth in _covered(u, v, inverse_z, area, height, width):
        nearest.scatter_reduce_(0, pixel, inverse_depth, "amax")
    first = torch.full((height * width,), NO_TRIANGLE, device=u.device)
    for chosen, pixel, inverse_depth in _covered(u, v, inverse_z, area, height, width):
        tied = inverse_depth >= nearest[pixel] * (1 - TIE_TOLERANCE)
        first.scatter_reduce_(0, pixel[tied], kept[chosen[tied]], "amin")
    return torch.where(first == NO_TRIANGLE, -1, first).view(height, width)


def _covered(
    u: Tensor, v: Tensor, inverse_z: Tensor, area: Tensor, height: int, width: int
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Pairs (triangle, pixel) where one covers the other, with the inverse depth there, in portions."""
    first_u, last_u = _span(u, width)
    first_v, last_v = _span(v, height)
    columns = (last_u - first_u + 1).clamp(min=0)
    ends = (columns * (last_v - first_v + 1).clamp(min=0)).cumsum(0)
    total = int(ends[-1]) if len(ends) else 0
    for start in range(0, total, PAIRS_AT_ONCE):
        pair = torch.arange(start, min(start + PAIRS_AT_ONCE, total), device=u.device)
        triangle = torch.searchsorted(ends, pair, right=True)
        within = pair - torch.where(triangle > 0, ends[triangle - 1], 0)
        pixel_u = first_u[triangle] + within % columns[triangle]
        pixel_v = first_v[triangle] + within // columns[triangle]
        du, dv = u[triangle] - pixel_u[:, None], v[triangle] - pixel_v[:, None]
        scale = 1 / area[triangle, None]
        weight = (du.roll(-1, 1) * dv.roll(-2, 1) - du.roll(-2, 1) * dv.roll(-1, 1)) * scale
        first, second, third = (weight * inverse_z[triangle]).unbind(-1)
        inverse_depth = first + second + third  # in this order, as in the fast versions
        inside = (weight >= -EDGE_TOLERANCE).all(-1) & (inverse_depth > 0)
        yield triangle[inside], (pixel_v * width + pixel_u)[inside], inverse_depth[inside]


def _span(coordinate: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """First and last pixel along one axis that the triangles (T, 3), grown by the tolerance, can cover."""
    low, high = coordinate.amin(-1), coordinate.amax(-1)
    margin = 3 * EDGE_TOLERANCE * (high - low)
    return (low - margin).ceil().clamp(0, size).long(), (high + margin).floor().clamp(-1, size - 1).long()


def intersect(vertices: Tensor, triangle: Tensor, focal_px: float) -> tuple[Tensor, Tensor]:
    """Canonical pixel coordinates and depth where each pixel's ray meets its triangle; 0 where there is none.

    For the ray r = (r_x, r_y, 1) let q_k = (x_k, y_k) - (r_x, r_y) z_k. The weights w_k = q_i x q_j are the
    determinants [r, P_i, P_j]. So b = w / sum(w) are perspective-correct: r z = sum b_k P_k.
    """
    height, width = triangle.shape[1:]
    image, v, u = seen = (triangle >= 0).nonzero(as_tuple=True)
    corners = triangle_corners(height, width, vertices.device)[triangle[image, v, u]]
    points = vertices.flatten(1, 2)[image[:, None], corners].double()
    ray_x, ray_y = (u.double() - (width - 1) / 2) / focal_px, (v.double() - (height - 1) / 2) / focal_px
    qx = points[..., 0] - ray_x[:, None] * points[..., 2]
    qy = points[..., 1] - ray_y[:, None] * points[..., 2]
    weight = qx.roll(-1, 1) * qy.roll(-2, 1) - qx.roll(-2, 1) * qy.roll(-1, 1)
    weight = weight / weight.sum(1, keepdim=True)
    carried = torch.stack((corners % width, corners // width), -1).double()
    uv = (weight[..., None] * carried).sum(1).to(vertices.dtype)
    depth = (weight * points[..., 2]).sum(1).to(vertices.dtype)
    blank = vertices.new_zeros(*triangle.shape, 2)
    return blank.index_put(seen, uv), blank[..., 0].index_put(seen, depth)
