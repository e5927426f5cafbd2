"""The square crop of an image that a model reconstructs best.

A model learns the crop of its training images; in another one it mistakes eyes for cheeks. Crops on a grid
are compared by the squared error of their reconstruction inside the mask, over the crop's variance: smooth
crops gain nothing. Leaves out rolled images, small objects, and crops that reach beyond the image.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn.functional import interpolate

SIDES = (0.9, 0.8, 0.7, 0.6, 0.5)
STEP = 0.1
FARTHEST_ACROSS, FARTHEST_DOWN = 0.2, 0.3
GAIN = 0.8
"""A crop is chosen where its error is below this share of the whole image's."""

SEARCH_SCALE = 2
"""How many times the model's size images should have in which crops are searched."""

_LEAST_VARIANCE = 1e-4


@dataclass(frozen=True)
class Crop:
    """A square part of a square image: its side over the image's, and its centre, -1 (left, top) to 1."""

    side: float = 1.0
    across: float = 0.0
    down: float = 0.0

    def __post_init__(self):
        room = 1 - self.side + 1e-9
        if not (0 < self.side <= 1 and abs(self.across) <= room and abs(self.down) <= room):
            raise ValueError(
                f"a crop lies inside the image: 0 < side <= 1 and its centre within 1 - side of the middle, "
                f"got {self}"
            )

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


def as_bytes(images: Float[Tensor, "n 3 h w"]) -> UInt8[Tensor, "n 3 h w"]:
    """Images in 0..1 as bytes, rounded."""
    return (images * 255).round().to(torch.uint8)


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
