"""Pictures as a camera would have taken them from nearer or farther, beside the middle, or turned.

A model knows the framing it was trained in, and users' pictures have others. Unlike light and view, another
frame of a picture needs no rendering: what it shows is right, and where its camera stands is known
(scene/frame.py). Beyond the picture's edge lies its reflection, or another picture in large patches.
Leaves out which framing suits a picture that is read (training/framing.py).
"""

import math

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Generator, Tensor
from torch.nn.functional import adaptive_avg_pool2d, affine_grid, grid_sample, interpolate

from derender.settings import Settings

_WHOLE = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


class ReframeSettings(Settings):
    """Largest change of a picture's frame; each number is drawn by itself, evenly (size: its logarithm)."""

    nearer: float = Field(default=1.4, ge=1, le=4)  # the thing is shown up to so many times as large
    farther: float = Field(default=1.4, ge=1, le=4)  # or as small
    shift: float = Field(default=0.12, ge=0, le=1)  # across and down, in half sides of the picture
    roll_deg: float = Field(default=10.0, ge=0, le=180)


DEFAULT_FRAMES = ReframeSettings()


def draw_frames(
    count: int, generator: Generator, settings: ReframeSettings, share: float = 1.0
) -> Float[Tensor, "n 2 3"]:
    """A frame for each picture, or a ``share`` of them: where its pixels lie in the picture, as affine map.

    Coordinates run from -1 to 1 across and down; the other pictures get the map that changes nothing.
    """

    def drawn(least: float, most: float) -> Tensor:
        return torch.rand(count, generator=generator) * (most - least) + least

    scale = drawn(-math.log(settings.nearer), math.log(settings.farther)).exp()
    turn = drawn(-math.radians(settings.roll_deg), math.radians(settings.roll_deg))
    across, down = (drawn(-settings.shift, settings.shift) for _ in range(2))
    stays = torch.rand(count, generator=generator) >= share
    cosine, sine = turn.cos() * scale, turn.sin() * scale
    frames = torch.stack([cosine, -sine, across, sine, cosine, down], dim=1).view(-1, 2, 3)
    return torch.where(stays.view(-1, 1, 1), _WHOLE, frames)


def shown_in(
    images: Float[Tensor, "n 3 h w"],
    frames: Float[Tensor, "n 2 3"],
    around: Float[Tensor, "n 3 h w"] | None = None,
) -> Float[Tensor, "n 3 h w"]:
    """Each picture in its frame, bilinear; one whose frame changes nothing comes back bit for bit.

    ``around`` is what is shown where a frame reaches beyond its picture, which else is reflected.
    """
    frames = frames.to(images)
    grid = affine_grid(frames, list(images.shape), align_corners=False)
    moved = grid_sample(images, grid, padding_mode="reflection", align_corners=False)
    if around is not None:
        beyond = (grid.abs() > 1).any(dim=-1)[:, None]
        moved = torch.where(beyond, around, moved)
    stays = (frames == _WHOLE.to(images)).flatten(1).all(dim=1)
    return torch.where(stays.view(-1, 1, 1, 1), images, moved)


def strange_surroundings(images: Float[Tensor, "n 3 h w"], generator: Generator) -> Float[Tensor, "n 3 h w"]:
    """For each picture another of the batch in large patches, from one to eight a side (drawn once)."""
    patches = int(torch.randint(1, 9, (), generator=generator))
    coarse = adaptive_avg_pool2d(images.roll(1, 0), patches)
    return interpolate(coarse, images.shape[-2:], mode="bilinear", align_corners=False)
