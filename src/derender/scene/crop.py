"""Images in other crops, as a camera nearer, farther, beside the middle or rolled would have taken them.

Unlike lighting and viewpoint, another crop of an image needs no rendering: its pixels are known, and so is
its camera. Crops are (n, 2, 3) affine maps: where each crop's points lie in the image, in coordinates from -1
to 1 across and down. Leaves out the search for the crop that suits a model (crop_search.py).
"""

import math

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Generator, Tensor
from torch.nn.functional import adaptive_avg_pool2d, affine_grid, grid_sample, interpolate

from derender.scene.camera import focal_px
from derender.scene.ranges import SceneRanges
from derender.scene.scene import Scene
from derender.settings import Settings

_IDENTITY = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
_REACH = 0.75  # of a range: towards its end a network's output hardly moves


class CropSettings(Settings):
    """Largest change of an image's crop; each number is uniform and independent (size: its logarithm)."""

    nearer: float = Field(default=1.4, ge=1, le=4)  # the object appears up to so many times as large
    farther: float = Field(default=1.4, ge=1, le=4)  # or as small
    shift: float = Field(default=0.12, ge=0, le=1)  # across and down, in half sides of the image
    roll_deg: float = Field(default=10.0, ge=0, le=180)


DEFAULT_CROPS = CropSettings()


def random_crops(
    count: int, generator: Generator, settings: CropSettings, share: float = 1.0
) -> Float[Tensor, "n 2 3"]:
    """A random crop for each image with probability ``share``, and the identity for the others."""

    def uniform(low: float, high: float) -> Tensor:
        return torch.rand(count, generator=generator) * (high - low) + low

    scale = uniform(-math.log(settings.nearer), math.log(settings.farther)).exp()
    roll = uniform(-math.radians(settings.roll_deg), math.radians(settings.roll_deg))
    across, down = (uniform(-settings.shift, settings.shift) for _ in range(2))
    unchanged = torch.rand(count, generator=generator) >= share
    cosine, sine = roll.cos() * scale, roll.sin() * scale
    crops = torch.stack([cosine, -sine, across, sine, cosine, down], dim=1).view(-1, 2, 3)
    return torch.where(unchanged.view(-1, 1, 1), _IDENTITY, crops)


def crop_images(
    images: Float[Tensor, "n 3 h w"],
    crops: Float[Tensor, "n 2 3"],
    surroundings: Float[Tensor, "n 3 h w"] | None = None,
) -> Float[Tensor, "n 3 h w"]:
    """Each image in its crop, bilinear; the identity crop returns the image bit for bit.

    A crop that reaches beyond its image shows ``surroundings`` there, by default the image's reflection.
    """
    crops = crops.to(images)
    grid = affine_grid(crops, list(images.shape), align_corners=False)
    cropped = grid_sample(images, grid, padding_mode="reflection", align_corners=False)
    if surroundings is not None:
        beyond = (grid.abs() > 1).any(dim=-1)[:, None]
        cropped = torch.where(beyond, surroundings, cropped)
    unchanged = (crops == _IDENTITY.to(images)).flatten(1).all(dim=1)
    return torch.where(unchanged.view(-1, 1, 1, 1), images, cropped)


def other_surroundings(images: Float[Tensor, "n 3 h w"], generator: Generator) -> Float[Tensor, "n 3 h w"]:
    """For each image another of the batch in large patches, one to eight a side (one number per batch)."""
    patches = int(torch.randint(1, 9, (), generator=generator))
    coarse = adaptive_avg_pool2d(images.roll(1, 0), patches)
    return interpolate(coarse, images.shape[-2:], mode="bilinear", align_corners=False)


def crop_scene(scene: Scene, crops: Float[Tensor, "n 2 3"], fov_deg: float) -> Scene:
    """The scenes of images in crops that are similarities, as `random_crops` makes them: cameras change.

    Exact at the distance of the object's middle; with a field of view of 10 degrees the rest is off by less
    than a pixel.
    """
    width = scene.depth.shape[-1]
    crops, focal = crops.to(scene.camera), focal_px(width, fov_deg) * 2 / width
    cosine, sine = crops[:, 0, 0], crops[:, 1, 0]
    scale, roll = torch.hypot(cosine, sine), torch.atan2(sine, cosine)
    distance = 1 + scene.camera[:, 5]
    x, y = (scene.camera[:, 3:5] - crops[:, :, 2] * distance[:, None] / focal).unbind(dim=1)
    pitch, yaw, rolled = scene.camera[:, :3].unbind(dim=1)
    across, down = (cosine * x + sine * y) / scale, (cosine * y - sine * x) / scale
    moved = torch.stack([pitch, yaw, rolled - roll, across, down, scale * distance - 1], dim=1)
    return scene.with_parameters(camera=moved)


def ranges_for_crops(ranges: SceneRanges, width: int, settings: CropSettings) -> SceneRanges:
    """Ranges that let the camera move as far as crops of images ``width`` pixels wide need; never smaller."""
    focal = focal_px(width, ranges.fov_deg) * 2 / width
    away = max(settings.farther - 1, 1 - 1 / settings.nearer) / _REACH
    aside = math.sqrt(2) * settings.shift * settings.farther / focal / _REACH
    needed = {"translation_xy": aside, "translation_z": away}
    return ranges.model_copy(
        update={name: max(getattr(ranges, name), value) for name, value in needed.items()}
    )
