"""Images in other crops, as a camera nearer, farther, beside the middle or rolled would have taken them.

Unlike lighting and viewpoint, another crop of an image needs no rendering: its pixels are known, and so is
its camera. Crops are (n, 2, 3) affine maps: where each crop's points lie in the image, in coordinates from -1
to 1 across and down.

A model learns the crop of its training images; in another one it mistakes eyes for cheeks. ``best_crop``
compares crops on a grid by the squared error of their reconstruction inside the mask, over the crop's
variance: smooth crops gain nothing. It leaves out rolled images, small objects, and crops that reach beyond
the image.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from pydantic import Field
from torch import Generator, Tensor
from torch.nn.functional import adaptive_avg_pool2d, affine_grid, grid_sample, interpolate

from derender.scene.camera import focal_px
from derender.scene.ranges import SceneRanges
from derender.scene.scene import Scene
from derender.settings import Settings

Crops = Float[Tensor, "n 2 3"]  # affine maps, as above
SIDES = (0.9, 0.8, 0.7, 0.6, 0.5)
STEP = 0.1
FARTHEST_ACROSS, FARTHEST_DOWN = 0.2, 0.3
GAIN = 0.8  # a crop is chosen where its error is below this share of the whole image's
SEARCH_SCALE = 2  # how many times the model's size images should have in which crops are searched
_LEAST_VARIANCE = 1e-4
_IDENTITY = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
_REACH = 0.75  # of a range: towards its end a network's output hardly moves


class CropSettings(Settings):
    """Largest change of an image's crop; each number is uniform and independent (size: its logarithm)."""

    nearer: float = Field(default=1.4, ge=1, le=4)  # the object appears up to so many times as large
    farther: float = Field(default=1.4, ge=1, le=4)  # or as small
    shift: float = Field(default=0.12, ge=0, le=1)  # across and down, in half sides of the image
    roll_deg: float = Field(default=10.0, ge=0, le=180)


DEFAULT_CROPS = CropSettings()


def random_crops(count: int, generator: Generator, settings: CropSettings, share: float = 1.0) -> Crops:
    """A random crop for each image with probability ``share``, and the identity for the others."""

    def uniform(low: float, high: float) -> Tensor:
        return torch.rand(count, generator=generator) * (high - low) + low

    scale = uniform(-math.log(settings.nearer), math.log(settings.farther)).exp()
    roll = uniform(-math.radians(settings.roll_deg), math.radians(settings.roll_deg))
    across, down = (uniform(-settings.shift, settings.shift) for _ in range(2))
    unchanged = torch.rand(count, generator=generator) >= share
    crops = similarities(torch.stack([scale.log(), roll, across, down], dim=1))
    return torch.where(unchanged.view(-1, 1, 1), _IDENTITY, crops)


def similarities(parameters: Float[Tensor, "n 4"]) -> Crops:
    """Crops of these logarithms of scale, rolls in radians, and places of the centre across and down."""
    scale, roll, across, down = parameters.unbind(dim=1)
    cosine, sine = roll.cos() * scale.exp(), roll.sin() * scale.exp()
    return torch.stack([cosine, -sine, across, sine, cosine, down], dim=1).view(-1, 2, 3)


def parameters_of(crops: Crops) -> Float[Tensor, "n 4"]:
    """What `similarities` makes these crops of."""
    cosine, sine = crops[:, 0, 0], crops[:, 1, 0]
    return torch.stack([torch.hypot(cosine, sine).log(), torch.atan2(sine, cosine), *crops[:, :, 2].T], dim=1)


def within(inner: Crops, outer: Crops) -> Crops:
    """Crops of crops: where the inner ones lie in the image that the outer ones are cut from."""
    turned = outer[:, :, :2] @ inner
    return torch.cat([turned[:, :, :2], turned[:, :, 2:] + outer[:, :, 2:]], dim=2)


def back(crops: Crops) -> Crops:
    """Where the image's points lie in each crop: a crop of a crop by this is the image."""
    turned = torch.linalg.inv(crops[:, :, :2])
    return torch.cat([turned, -turned @ crops[:, :, 2:]], dim=2)


def crop_images(
    images: Float[Tensor, "n c h w"], crops: Crops, surroundings: Float[Tensor, "n c h w"] | None = None
) -> Float[Tensor, "n c h w"]:
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


def crop_scene(scene: Scene, crops: Crops, fov_deg: float) -> Scene:
    """The scenes of images in crops that are similarities, as `random_crops` makes them: cameras change.

    Exact at the distance of the object's middle; with a field of view of 10 degrees the rest is off by less
    than a pixel.
    """
    width = scene.depth.shape[-1]
    crops, focal = crops.to(scene.camera), focal_px(width, fov_deg) * 2 / width
    (logarithm, roll), (cosine, sine) = parameters_of(crops)[:, :2].T, crops[:, :, 0].T
    scale = logarithm.exp()
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
    wider = {"translation_xy": max(ranges.translation_xy, aside)}
    return ranges.model_copy(update=wider | {"translation_z": max(ranges.translation_z, away)})


@dataclass(frozen=True)
class Crop:
    """A square part of a square image: its side over the image's, and its centre, -1 (left, top) to 1."""

    side: float = 1.0
    across: float = 0.0
    down: float = 0.0

    def __post_init__(self):
        room = 1 - self.side + 1e-9
        if not (0 < self.side <= 1 and abs(self.across) <= room and abs(self.down) <= room):
            needed = "0 < side <= 1 and its centre within 1 - side of the middle"
            raise ValueError(f"a crop lies inside the image: {needed}, got {self}")

    def corner(self, size: int) -> tuple[int, int, int]:
        """Left, top and side in pixels, in an image of ``size``."""
        side = max(1, round(self.side * size))
        left, top = (round((1 + at - self.side) / 2 * size) for at in (self.across, self.down))
        return min(left, size - side), min(top, size - side), side

    def cut(self, images: UInt8[Tensor, "n 3 r r"], size: int) -> Float[Tensor, "n 3 size size"]:
        """The crop in 0..1, resampled (antialiased) to ``size`` where it has another one."""
        left, top, side = self.corner(images.shape[-1])
        part = images[:, :, top : top + side, left : left + side].float() / 255
        if side == size:
            return part
        return interpolate(part, size=(size, size), mode="bilinear", antialias=True).clamp(0, 1)


WHOLE = Crop()


def candidate_crops() -> list[Crop]:
    """The grid of the search: the whole image first, then smaller crops, none beyond the image."""
    crops = [WHOLE]
    for side in SIDES:
        across, down = (
            [round(STEP * step, 6) for step in range(-steps, steps + 1)]
            for steps in (int(min(far, 1 - side) / STEP + 1e-6) for far in (FARTHEST_ACROSS, FARTHEST_DOWN))
        )
        crops += [Crop(side, x, y) for y in down for x in across]
    return crops


@torch.inference_mode()
def crop_errors(
    model: Any, images: UInt8[Tensor, "n 3 r r"], crops: Sequence[Crop], batch_size: int = 64
) -> Float[np.ndarray, "crops n"]:
    """Squared error of each crop's reconstruction over its variance: best 0; inf where nothing is rendered.

    ``model`` has ``reconstruct``, ``device`` and ``image_size``; images are best ``SEARCH_SCALE`` times that.
    """
    columns = []
    for few in images.split(max(1, batch_size // len(crops))):
        errors = []
        for batch in torch.cat([crop.cut(few, model.image_size) for crop in crops]).split(batch_size):
            target = batch.to(model.device)
            rendering = model.reconstruct(target)
            mask = rendering.mask.unsqueeze(1)
            covered = mask.sum(dim=(1, 2, 3))
            mean = (target * mask).sum(dim=(2, 3), keepdim=True) / covered.clamp(min=1).view(-1, 1, 1, 1)
            error = ((rendering.image - target).square() * mask).sum(dim=(1, 2, 3))
            variance = ((target - mean).square() * mask).sum(dim=(1, 2, 3))
            share = error / torch.maximum(variance, _LEAST_VARIANCE * covered).clamp(min=1e-12)
            errors.append(torch.where(covered > 0, share, torch.inf).cpu())
        columns.append(torch.cat(errors).view(len(crops), len(few)))
    return torch.cat(columns, dim=1).numpy()


def best_crop(model: Any, views: UInt8[Tensor, "n 3 r r"]) -> tuple[int, Crop]:
    """Of squares of one photograph the number of one, and its crop, that the model reconstructs best.

    The whole first square, where none is clearly better.
    """
    crops = candidate_crops()
    errors = crop_errors(model, views, crops)
    crop, view = divmod(int(errors.argmin()), len(views))
    return (view, crops[crop]) if errors[crop, view] < GAIN * errors[0, 0] else (0, WHOLE)
