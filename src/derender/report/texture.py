"""Albedo from the image itself: what the model has blurred, taken back from the pixels it was given.

The image divided by the model's shading, seen in the image's own view, is albedo wherever the model's
geometry and light are right. Each canonical point looks it up where the camera sees that point; where it is
hidden, turned away, outside the image or nearly dark, the model's albedo stays, and the two are blended in
between. So the scene's own rendering gives the image back where the surface is seen. Leaves out filling the
hidden side from its mirror image, and anything that repairs wrong geometry.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, max_pool2d

from derender.render import warp
from derender.scene import Scene
from derender.scene.camera import project, to_camera, unproject
from derender.scene.enlarge import cubic_weights
from derender.scene.light import lambert_shading
from derender.scene.normals import normals_from_depth

FACING = (
    0.15,
    0.40,
)  # cosine between surface and ray: below the first the model's albedo, above the image's
LIT = (0.10, 0.25)  # shading, likewise
HIDDEN_BEHIND = 0.01  # scene units that a point may lie behind what is seen there
FEATHER_SHARE = 1 / 32  # width of the blend, of the image's width


def picture_albedo(
    pictures: Float[Tensor, "n 3 h w"], scene: Scene, fov_deg: float
) -> Float[Tensor, "n 3 h w"]:
    """Albedo (0..1) in the canonical view from images (0..1) at the size of their scenes."""
    if pictures.shape != scene.albedo.shape:
        raise ValueError(
            f"images and scenes need one size, got {tuple(pictures.shape)} and "
            f"{tuple(scene.albedo.shape)}: enlarge the scenes with derender.scene.enlarge.at_size"
        )
    share, looked_up = _seen(pictures, scene, fov_deg)
    return share * looked_up + (1 - share) * scene.albedo


def picture_on_grid(picture: Float[Tensor, "n 3 s s"], model_size: int) -> Float[Tensor, "n 3 s s"]:
    """A large image on the grid of an enlarged scene, whose outermost centres are the model's own.

    Resizing keeps the image's edges in place, enlarging a scene keeps its outermost pixel centres: half a
    pixel of the model's at each side falls away.
    """
    size = picture.shape[-1]
    centre = 0.5 / model_size  # of the model's outermost pixel, as a share of the image
    places = torch.linspace(centre, 1 - centre, size, dtype=torch.float64) * size - 0.5
    along = cubic_weights(places, size, "sharp").to(picture)
    return (along @ picture @ along.T).clamp(0, 1)


def _seen(pictures: Tensor, scene: Scene, fov_deg: float) -> tuple[Tensor, Tensor]:
    """Share (N, 1, H, W) of each canonical point's albedo that the image can tell, and that albedo."""
    height, width = scene.depth.shape[-2:]
    shading = lambert_shading(normals_from_depth(scene.depth, fov_deg), scene.light)
    view = warp(shading, scene.depth, scene.camera, fov_deg)
    bare = (pictures / view.image.clamp(min=LIT[0])).clamp(0, 1)

    points = to_camera(unproject(scene.depth, fov_deg), scene.camera)
    place = project(points, height, width, fov_deg)
    last = place.new_tensor([width - 1, height - 1])
    grid = 2 * place / last - 1
    looked_up = grid_sample(bare, grid, mode="bilinear", padding_mode="border", align_corners=True)
    front = grid_sample(view.depth[:, None], grid, mode="nearest", padding_mode="zeros", align_corners=True)

    inside = (grid.abs() <= 1).all(dim=-1)
    visible = inside & (points[..., 2] <= front[:, 0] + HIDDEN_BEHIND) & (front[:, 0] > 0)
    certain = visible[:, None] * _ramp(_facing(points), *FACING)[:, None] * _ramp(shading, *LIT)
    return _feathered(certain, max(1, round(FEATHER_SHARE * width))), looked_up


def _facing(points: Float[Tensor, "n h w 3"]) -> Float[Tensor, "n h w"]:
    """Cosine between the moved surface and the ray to it; negative where it is seen from behind."""
    along_u = torch.gradient(points, dim=2)[0]
    along_v = torch.gradient(points, dim=1)[0]
    normal = torch.linalg.cross(along_u, along_v)
    cosine = (normal * points).sum(dim=-1)
    return cosine / (normal.norm(dim=-1) * points.norm(dim=-1)).clamp(min=1e-12)


def _ramp(value: Tensor, low: float, high: float) -> Tensor:
    return ((value - low) / (high - low)).clamp(0, 1)


def _feathered(share: Float[Tensor, "n 1 h w"], reach: int) -> Float[Tensor, "n 1 h w"]:
    """The share shrunk by ``reach`` pixels and blurred by as much: smooth, and 0 wherever it was 0."""
    side = 2 * reach + 1
    shrunk = -max_pool2d(-share, side, stride=1, padding=reach)
    return avg_pool2d(shrunk, side, stride=1, padding=reach, count_include_pad=False)
