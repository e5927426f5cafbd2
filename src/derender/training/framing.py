"""Which square part of pictures a model should be shown: the one that it renders again best.

A model knows the framing it was trained in: where the thing lies and how much of the picture it fills. In
another one it is misread, eyes on cheeks. Parts on a grid are rendered again and compared by their squared
error over the part's own variance, both inside the mask, so that a smooth part gains nothing by being smooth.
Needs neither labels nor a detector. Leaves out turned pictures, things that fill less than half of the
picture's side, and parts that reach beyond it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn.functional import interpolate

from derender.data import as_float

SIDES = (0.9, 0.8, 0.7, 0.6, 0.5)
STEP = 0.1
FARTHEST = {"across": 0.2, "down": 0.3}
GAIN = 0.8
"""A part is taken where its error is below this share of the whole picture's."""

READ_LARGER = 2
"""How many times the model's size pictures should have where parts are looked for."""

_LEAST_VARIANCE = 1e-4


@dataclass(frozen=True)
class Framing:
    """A square part of a square picture.

    Attributes:
        side: its side over the picture's, up to 1.
        across, down: where its centre lies, -1 (left, top) to 1; within ``1 - side`` of 0.
    """

    side: float = 1.0
    across: float = 0.0
    down: float = 0.0

    def __post_init__(self):
        room = 1 - self.side + 1e-9
        if not (0 < self.side <= 1 and abs(self.across) <= room and abs(self.down) <= room):
            raise ValueError(
                f"a framing lies inside the picture: 0 < side <= 1 and its centre within 1 - side of the "
                f"middle, got {self}"
            )

    def corner(self, size: int) -> tuple[int, int, int]:
        """Left, top and side in pixels, in a picture of ``size``."""
        side = max(1, round(self.side * size))
        left, top = (round((1 + at - self.side) / 2 * size) for at in (self.across, self.down))
        return min(left, size - side), min(top, size - side), side

    def cut(self, images: UInt8[Tensor, "n 3 r r"], size: int) -> Float[Tensor, "n 3 size size"]:
        """The part in 0..1, resampled (antialiased) to ``size`` where it has another one."""
        left, top, side = self.corner(images.shape[-1])
        part = as_float(images[:, :, top : top + side, left : left + side])
        if side == size:
            return part
        return interpolate(part, size=(size, size), mode="bilinear", antialias=True).clamp(0, 1)


WHOLE = Framing()


def as_bytes(images: Float[Tensor, "n 3 h w"]) -> UInt8[Tensor, "n 3 h w"]:
    """Pictures in 0..1 as bytes, rounded."""
    return (images * 255).round().to(torch.uint8)


def framings() -> list[Framing]:
    """All that are tried: the whole picture first, then smaller parts, none beyond the picture."""
    found = [WHOLE]
    for side in SIDES:
        across, down = (_places(min(far, 1 - side)) for far in FARTHEST.values())
        found += [Framing(side, x, y) for y in down for x in across]
    return found


def _places(far: float) -> list[float]:
    steps = int(far / STEP + 1e-6)
    return [round(STEP * step, 6) for step in range(-steps, steps + 1)]


def framing_errors(
    model: Any, images: UInt8[Tensor, "n 3 r r"], tried: Sequence[Framing], batch_size: int = 64
) -> Float[np.ndarray, "tried n"]:
    """How badly the model renders each part again: squared error over variance, best 0; inf for no rendering.

    Args:
        model: with ``reconstruct``, ``device`` and ``image_size``, in evaluation mode.
        images: square pictures, best of ``READ_LARGER`` times the model's size or more.
        tried: parts.
        batch_size: parts rendered at a time; changes speed and memory only.
    """
    columns = []
    with torch.inference_mode():
        for few in images.split(max(1, batch_size // len(tried))):
            parts = torch.cat([framing.cut(few, model.image_size) for framing in tried])
            found = torch.cat([_unexplained(model, batch) for batch in parts.split(batch_size)])
            columns.append(found.view(len(tried), len(few)))
    return torch.cat(columns, dim=1).numpy()


def _unexplained(model: Any, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, " n"]:
    target = images.to(model.device)
    seen = model.reconstruct(target)
    mask = seen.mask.unsqueeze(1)
    covered = mask.sum(dim=(1, 2, 3))
    mean = (target * mask).sum(dim=(2, 3), keepdim=True) / covered.clamp(min=1).view(-1, 1, 1, 1)
    off = ((seen.image - target).square() * mask).sum(dim=(1, 2, 3))
    own = ((target - mean).square() * mask).sum(dim=(1, 2, 3))
    share = off / torch.maximum(own, _LEAST_VARIANCE * covered).clamp(min=1e-12)
    return torch.where(covered > 0, share, torch.inf).cpu()


def each_framing(model: Any, images: UInt8[Tensor, "n 3 r r"]) -> list[Framing]:
    """The part of each picture that the model renders again best; the whole where none is clearly better."""
    tried = framings()
    errors = framing_errors(model, images, tried)
    return [_chosen(tried, column) for column in errors.T]


def common_framing(model: Any, images: UInt8[Tensor, "n 3 r r"]) -> Framing:
    """The one part for all pictures whose median error is lowest; the whole where none is clearly better."""
    tried = framings()
    return _chosen(tried, np.median(framing_errors(model, images, tried), axis=1))


def _chosen(tried: Sequence[Framing], errors: Float[np.ndarray, " tried"]) -> Framing:
    best = int(errors.argmin())
    return tried[best] if errors[best] < GAIN * errors[0] else tried[0]
