"""Sizes of the networks; image to code: strided convolutions down to 4x4 pixels, then one convolution to 1x1.

Source: unsup3d's networks as pinned in the paper's appendix; the U-Net encoder is the one the paper swaps in
for segmentation. Its expanding half is that of Ronneberger et al., MICCAI 2015. No convolution before a code
has a bias. Input images are 0..1 and are moved to -1..1 here.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Literal

import torch
from jaxtyping import Float, UInt8
from pydantic import Field, field_validator, model_validator
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d, leaky_relu

from derender.settings import Settings

IMAGE_SIZES = (32, 64, 128, 256)
MAX_PLACES = 2048  # numbers of the last spatial map among the activations

Images = Float[Tensor, "n 3 h w"]
Pixels = UInt8[Tensor, "n 3 h w"]
Code = Float[Tensor, "n code"]
Spatial = Float[Tensor, "n channels y x"]

LARGEST = 1 << 16  # of channels and codes; more is no network


class NetworkSettings(Settings):
    """Sizes of the networks; the defaults are the paper's.

    Geometry and albedo start at ``width`` channels, light and camera at ``light_width``, and double to 8x
    that. ``unet_decoder`` adds a decoder over the U-Nets of geometry and albedo (``derender unet``).
    Networks that were ``grown_from`` a smaller image size encode images reduced to it, and their decoders of
    maps end in further doublings.
    """

    image_size: int = 64  # side of square images in pixels
    grown_from: int | None = None  # side that encoders reduce images to; None: image_size
    width: int = Field(default=64, ge=4, le=LARGEST, multiple_of=4)  # channels of the first layers
    light_width: int = Field(default=32, ge=1, le=LARGEST)  # of light's and camera's networks
    code_size: int = Field(default=256, ge=1, le=LARGEST)  # dimensions of each factor's code
    confidence_code_size: int = Field(default=128, ge=1, le=LARGEST)  # of the net used in training only
    encoder: Literal["conv", "unet"] = "conv"  # unet: encoders with maps of every resolution
    unet_width: int = Field(default=16, ge=1, le=LARGEST)  # first channels of U-Net encoders
    unet_decoder: bool = False  # with the decoder of derender unet

    @field_validator("image_size")
    @classmethod
    def _one_of(cls, value: int) -> int:
        if value not in IMAGE_SIZES:
            raise ValueError(f"image_size must be one of {', '.join(map(str, IMAGE_SIZES))}, got {value}")
        return value

    @model_validator(mode="after")
    def _grown(self) -> "NetworkSettings":
        smaller = IMAGE_SIZES[: IMAGE_SIZES.index(self.image_size)]
        if self.grown_from is not None and (self.grown_from not in smaller or self.encoder == "unet"):
            wanted, got = f"an image size below {self.image_size}", f"{self.grown_from} and {self.encoder}"
            raise ValueError(f"grown_from must be {wanted} and the encoder conv, got {got}")
        return self

    @property
    def encoded_size(self) -> int:
        """Side in pixels at which images are encoded."""
        return self.grown_from or self.image_size

    @property
    def doublings(self) -> int:
        """How many doublings take maps of the encoded size to the image size."""
        return (self.image_size // self.encoded_size).bit_length() - 1

    @property
    def stages(self) -> int:
        """How many halvings take an encoded image to 4x4 pixels."""
        return self.encoded_size.bit_length() - 3


def stage_widths(first: int, stages: int) -> list[int]:
    """Channels after each halving: doubling from ``first``, never above 8 times it."""
    return [first * min(2**stage, 8) for stage in range(stages)]


def unet_widths(settings: NetworkSettings) -> list[int]:
    """Channels at each level of a U-Net, finest first, doubling down to 4x4 pixels."""
    return [settings.unet_width * 2**level for level in range(settings.stages + 1)]


def reduced(images: Images, settings: NetworkSettings) -> Float[Tensor, "n 3 side side"]:
    """Images at the size at which they are encoded: averages of blocks of pixels, or as they are."""
    side = settings.encoded_size
    return adaptive_avg_pool2d(images, side) if images.shape[-1] > side else images


class NormReLU(nn.GroupNorm):
    """Group normalisation (Wu & He 2018), four channels a group; then keep ``slope`` of negative values."""

    def __init__(self, channels: int, slope: float = 0.0):
        super().__init__(channels // 4, channels)
        self.slope = slope

    def forward(self, input: Spatial) -> Spatial:
        normalised = super().forward(input.to(self.weight.dtype)).to(input.dtype)  # slow in bfloat16
        return leaky_relu(normalised, self.slope) if self.slope else normalised.relu()


def activations(code: Code, spatial: Spatial) -> Float[Tensor, "n _"]:
    """Encoder activations, one row per image: the code, then the last spatial map."""
    # the map is averaged over 2x2 locations, then over all, where it holds more than 2,048 numbers
    side = spatial.shape[-1]
    while side > 1 and spatial.shape[1] * side**2 > MAX_PLACES:
        side //= 2
    pooled = spatial if side == spatial.shape[-1] else adaptive_avg_pool2d(spatial, side)
    return torch.cat([code, pooled.flatten(1)], dim=1)


class Encoder(nn.Module):
    """Strided convolutions to a code of 1x1 pixels; ``spatial`` gives the 4x4 features before the code."""

    def __init__(self, settings: NetworkSettings, width: int, code_size: int, *, normalised: bool):
        super().__init__()
        widths = stage_widths(width, settings.stages)
        layers: list[nn.Module] = []
        for stage, (previous, channels) in enumerate(zip([3, *widths], widths, strict=False)):
            layers.append(nn.Conv2d(previous, channels, 4, stride=2, padding=1, bias=False))
            rectifier = nn.LeakyReLU(0.2) if normalised else nn.ReLU()
            last = stage == settings.stages - 1
            layers.append(NormReLU(channels, slope=0.2) if normalised and not last else rectifier)
        self.convolutions = nn.Sequential(*layers)
        self.to_code = nn.Sequential(nn.Conv2d(widths[-1], code_size, 4, bias=False), nn.ReLU())
        self.code_size, self.settings = code_size, settings

    def spatial(self, images: Images) -> Spatial:
        return self.convolutions(reduced(images, self.settings) * 2 - 1)

    def forward(self, images: Images) -> Code:
        return self.to_code(self.spatial(images)).flatten(1)


class UNetEncoder(nn.Module):
    """The contracting half of a U-Net, with a code read from its 4x4 centre."""

    def __init__(self, settings: NetworkSettings, code_size: int):
        super().__init__()
        widths = unet_widths(settings)
        self.levels = nn.ModuleList(double_convolution(*pair) for pair in pairwise([3, *widths]))
        self.pool = nn.MaxPool2d(2)
        self.to_code = nn.Sequential(nn.Conv2d(widths[-1], code_size, 4, bias=False), nn.ReLU())
        self.code_size, self.widths = code_size, widths

    def skips(self, images: Images) -> list[Tensor]:
        """Features after each level, from full resolution down to 4x4, for a segmentation decoder."""
        result = [self.levels[0](images * 2 - 1)]
        for block in self.levels[1:]:
            result.append(block(self.pool(result[-1])))
        return result

    def spatial(self, images: Images) -> Spatial:
        return self.skips(images)[-1]

    def forward(self, images: Images) -> Code:
        return self.to_code(self.spatial(images)).flatten(1)


def double_convolution(channels_in: int, channels_out: int) -> nn.Sequential:
    """Twice a 3x3 convolution, BatchNorm and ReLU: a level of a U-Net."""
    layers: list[nn.Module] = []
    for previous in (channels_in, channels_out):
        layers.append(nn.Conv2d(previous, channels_out, 3, padding=1, bias=False))
        layers += [nn.BatchNorm2d(channels_out), nn.ReLU()]
    return nn.Sequential(*layers)


PIXEL_CHANNELS: Mapping[str, int] = {"geometry": 3, "albedo": 3}
"""Outputs of a trained decoder per pixel, by factor: position on the object across and down, and depth; red,
green, blue (training/unets.py)."""


class UNetDecoder(nn.Module):
    """Features at every resolution, finest first, of all encoders, to one value a class and pixel."""

    def __init__(self, widths: Sequence[int], encoders: int, outputs: int):
        super().__init__()
        self.upsample, self.convolve = nn.ModuleList(), nn.ModuleList()
        channels = encoders * widths[-1]
        for _, finer in pairwise(reversed(widths)):
            self.upsample.append(nn.ConvTranspose2d(channels, finer, 2, stride=2))
            self.convolve.append(double_convolution((1 + encoders) * finer, finer))
            channels = finer
        self.to_outputs = nn.Conv2d(channels, outputs, 1)

    def forward(self, skips: Sequence[Float[Tensor, "n _ _ _"]]) -> Float[Tensor, "n outputs h w"]:
        *finer, features = skips
        for up, convolve, skip in zip(self.upsample, self.convolve, reversed(finer), strict=True):
            features = convolve(torch.cat([skip, up(features)], dim=1))
        return self.to_outputs(features)


def pixel_decoder(settings: NetworkSettings) -> UNetDecoder:
    """The decoder over the U-Nets of geometry and albedo that a model may have; rendering never asks it."""
    outputs = sum(PIXEL_CHANNELS.values())
    return UNetDecoder(unet_widths(settings), len(PIXEL_CHANNELS), outputs).requires_grad_(False)
