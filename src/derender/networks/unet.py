"""The expanding half of a U-Net, over the skip features of one encoder or of several side by side.

Source: Ronneberger et al., MICCAI 2015; Klinghoffer et al., ECCV 2022, Sec. 4.7 joins two encoders by
stacking their features at each skip, and here at the centre, too. Leaves out cropping: convolutions are
padded.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

from derender.networks.encoders import NetworkSettings, double_convolution, unet_widths

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
