"""Augmentations with torch alone: crop, flip, colour jitter, grey, blur; each drawn for every picture.

Source: SimCLR (Chen et al. 2020, appendix A) with half its strengths for colours; crops keep more of the
picture by default, because ours are aligned and small. Pictures are 0..1 before and after. Leaves out hue in
HSV: it turns about the grey axis of RGB.
"""

import math

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Generator, Tensor
from torch.nn.functional import affine_grid, conv2d, grid_sample, pad

from derender.settings import Settings

LUMINANCE = (0.299, 0.587, 0.114)


class AugmentSettings(Settings):
    """Strengths and probabilities; 0 switches one off (``crop_from`` 1 and ``aspect`` 1 do so with crops)."""

    crop_from: float = Field(default=0.3, gt=0, le=1)  # smallest share of the area that a crop keeps
    aspect: float = Field(default=4 / 3, ge=1)  # largest width over height of a crop, and its inverse
    flip: float = Field(default=0.5, ge=0, le=1)
    jitter: float = Field(default=0.8, ge=0, le=1)
    brightness: float = Field(default=0.4, ge=0, lt=1)
    contrast: float = Field(default=0.4, ge=0, lt=1)
    saturation: float = Field(default=0.4, ge=0, lt=1)
    hue_deg: float = Field(default=36.0, ge=0, le=180)
    grey: float = Field(default=0.2, ge=0, le=1)
    blur: float = Field(default=0.5, ge=0, le=1)
    blur_px: tuple[float, float] = (0.1, 1.0)  # standard deviation, smallest and largest


def augment(
    images: Float[Tensor, "n 3 h w"], settings: AugmentSettings, generator: Generator
) -> Float[Tensor, "n 3 h w"]:
    """A random view of every picture, in 0..1; the same generator gives the same views."""
    images = crop(images, settings, generator)
    images = where(settings.flip, images.flip(-1), images, generator)
    images = where(settings.jitter, jitter(images, settings, generator), images, generator)
    images = where(settings.grey, grey(images), images, generator)
    return where(settings.blur, blur(images, settings.blur_px, generator), images, generator)


def where(
    probability: float,
    changed: Float[Tensor, "n 3 h w"],
    kept: Float[Tensor, "n 3 h w"],
    generator: Generator,
) -> Float[Tensor, "n 3 h w"]:
    """Each picture changed with this probability."""
    chosen = torch.rand(len(kept), generator=generator) < probability
    return torch.where(chosen.to(kept.device)[:, None, None, None], changed, kept)


def crop(
    images: Float[Tensor, "n 3 h w"], settings: AugmentSettings, generator: Generator
) -> Float[Tensor, "n 3 h w"]:
    """A part of every picture, inside it, stretched to the full size (bilinear)."""
    count = len(images)
    area = _uniform((count,), settings.crop_from, 1.0, generator)
    stretch = _uniform((count,), -math.log(settings.aspect), math.log(settings.aspect), generator).exp()
    sides = torch.stack([(area * stretch).sqrt(), (area / stretch).sqrt()], dim=1).clamp(max=1.0)
    centre = _uniform((count, 2), -1.0, 1.0, generator) * (1 - sides)  # -1..1 spans the picture
    return cut(images, sides, centre)


def cut(
    images: Float[Tensor, "n 3 h w"], sides: Float[Tensor, "n 2"], centre: Float[Tensor, "n 2"]
) -> Float[Tensor, "n 3 h w"]:
    """The part with these sides (share of width, height) about this centre (x, y; -1..1 is the picture)."""
    change = torch.cat([torch.diag_embed(sides), centre[:, :, None]], dim=2).to(images)
    grid = affine_grid(change, list(images.shape), align_corners=False)
    return grid_sample(images, grid, padding_mode="border", align_corners=False)


def jitter(
    images: Float[Tensor, "n 3 h w"], settings: AugmentSettings, generator: Generator
) -> Float[Tensor, "n 3 h w"]:
    """Brightness, contrast about the picture's mean grey, saturation about each pixel's grey, hue."""
    count = len(images)

    def gain(strength: float) -> Tensor:
        return _uniform((count, 1, 1, 1), 1 - strength, 1 + strength, generator).to(images)

    images = (images * gain(settings.brightness)).clamp(0, 1)
    mean = grey(images).mean(dim=(1, 2, 3), keepdim=True)
    images = (mean + (images - mean) * gain(settings.contrast)).clamp(0, 1)
    colourless = grey(images)
    images = (colourless + (images - colourless) * gain(settings.saturation)).clamp(0, 1)
    angle = math.radians(settings.hue_deg)
    return turn_hue(images, _uniform((count,), -angle, angle, generator).to(images)).clamp(0, 1)


def turn_hue(images: Float[Tensor, "n 3 h w"], angle_rad: Float[Tensor, " n"]) -> Float[Tensor, "n 3 h w"]:
    """Colours turned about the grey axis of RGB; greys stay, three turns of 120 degrees are none."""
    cosine, sine = angle_rad.cos(), angle_rad.sin()
    same = cosine + (1 - cosine) / 3
    ahead = (1 - cosine) / 3 - sine / math.sqrt(3)
    behind = (1 - cosine) / 3 + sine / math.sqrt(3)
    rows = [(same, ahead, behind), (behind, same, ahead), (ahead, behind, same)]
    turn = torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)
    return torch.einsum("nij,njhw->nihw", turn, images)


def grey(images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
    """Luminance in all three channels (ITU-R BT.601)."""
    weights = torch.tensor(LUMINANCE, device=images.device, dtype=images.dtype).view(1, 3, 1, 1)
    return (images * weights).sum(dim=1, keepdim=True).expand_as(images)


def blur(
    images: Float[Tensor, "n 3 h w"], sigma_px: tuple[float, float], generator: Generator
) -> Float[Tensor, "n 3 h w"]:
    """Gaussian blur with a standard deviation drawn for every picture; borders are mirrored."""
    count, channels, height, width = images.shape
    sigma = _uniform((count, 1), *sigma_px, generator).to(images)
    reach = min(math.ceil(3 * sigma_px[1]), height - 1, width - 1)
    steps = torch.arange(-reach, reach + 1, device=images.device)
    kernel = (-0.5 * (steps / sigma).square()).exp()
    kernel = (kernel / kernel.sum(dim=1, keepdim=True)).repeat_interleave(channels, dim=0)
    flat = images.reshape(1, count * channels, height, width)
    flat = conv2d(pad(flat, (reach, reach, 0, 0), "reflect"), kernel[:, None, None, :], groups=len(kernel))
    flat = conv2d(pad(flat, (0, 0, reach, reach), "reflect"), kernel[:, None, :, None], groups=len(kernel))
    return flat.reshape(images.shape)


def _uniform(shape: tuple[int, ...], low: float, high: float, generator: Generator) -> Tensor:
    return low + (high - low) * torch.rand(shape, generator=generator)
