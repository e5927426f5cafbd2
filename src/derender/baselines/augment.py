"""Augmentations in torch: crop, flip, colour jitter, grey, blur; each random for every image.

Source: SimCLR (Chen et al. 2020, appendix A) with half its strengths for colours; crops keep more of the
image by default, because ours are aligned and small. Images are 0..1 before and after. Leaves out hue in HSV:
colours rotate about the grey axis of RGB.
"""

import math

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Generator, Tensor
from torch.nn.functional import affine_grid, conv2d, grid_sample, pad

from derender.baselines.model import Images
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


def augment(images: Images, settings: AugmentSettings, generator: Generator) -> Images:
    """A random view of every image, in 0..1; the same generator gives the same views."""
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
) -> Images:
    """Each image changed with this probability."""
    chosen = torch.rand(len(kept), generator=generator) < probability
    return torch.where(chosen.to(kept.device)[:, None, None, None], changed, kept)


def crop(images: Images, settings: AugmentSettings, generator: Generator) -> Images:
    """A part of every image, inside it, stretched to the full size (bilinear)."""
    count = len(images)
    area = _uniform((count,), settings.crop_from, 1.0, generator)
    stretch = _uniform((count,), -math.log(settings.aspect), math.log(settings.aspect), generator).exp()
    sides = torch.stack([(area * stretch).sqrt(), (area / stretch).sqrt()], dim=1).clamp(max=1.0)
    centre = _uniform((count, 2), -1.0, 1.0, generator) * (1 - sides)  # -1..1 spans the image
    change = torch.cat([torch.diag_embed(sides), centre[:, :, None]], dim=2).to(images)
    grid = affine_grid(change, list(images.shape), align_corners=False)
    return grid_sample(images, grid, padding_mode="border", align_corners=False)


def jitter(images: Images, settings: AugmentSettings, generator: Generator) -> Images:
    """Brightness, contrast about the image's mean grey, saturation about each pixel's grey, hue."""
    count = len(images)

    def gain(strength: float) -> Tensor:
        return _uniform((count, 1, 1, 1), 1 - strength, 1 + strength, generator).to(images)

    images = (images * gain(settings.brightness)).clamp(0, 1)
    mean = grey(images).mean(dim=(1, 2, 3), keepdim=True)
    images = (mean + (images - mean) * gain(settings.contrast)).clamp(0, 1)
    colourless = grey(images)
    images = (colourless + (images - colourless) * gain(settings.saturation)).clamp(0, 1)
    angle = math.radians(settings.hue_deg)
    return rotate_hue(images, _uniform((count,), -angle, angle, generator).to(images)).clamp(0, 1)


def rotate_hue(images: Images, angle_rad: Float[Tensor, " n"]) -> Images:
    """Colours rotated about the grey axis of RGB; greys stay."""
    cosine, sine = angle_rad.cos(), angle_rad.sin()
    same = cosine + (1 - cosine) / 3
    ahead = (1 - cosine) / 3 - sine / math.sqrt(3)
    behind = (1 - cosine) / 3 + sine / math.sqrt(3)
    rows = [(same, ahead, behind), (behind, same, ahead), (ahead, behind, same)]
    rotation = torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)
    return torch.einsum("nij,njhw->nihw", rotation, images)


def grey(images: Images) -> Images:
    """Luminance in all three channels (ITU-R BT.601)."""
    weights = torch.tensor(LUMINANCE, device=images.device, dtype=images.dtype).view(1, 3, 1, 1)
    return (images * weights).sum(dim=1, keepdim=True).expand_as(images)


def blur(images: Images, sigma_px: tuple[float, float], generator: Generator) -> Images:
    """Gaussian blur with a standard deviation drawn for every image; borders are mirrored."""
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
