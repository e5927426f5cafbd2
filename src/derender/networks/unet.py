"""The expanding half of a U-Net, over the skip features of one encoder or of several side by side.

Source: Ronneberger et al., MICCAI 2015; Klinghoffer et al., ECCV 2022, Sec. 4.7 joins two encoders by
stacking their features at each skip, and here at the centre, too. Leaves out cropping: convolutions are
padded.
"""

import copy
from collections.abc import Mapping, Sequence
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

from derender.networks.encoders import NetworkSettings, UNetEncoder, double_convolution, unet_widths

PIXEL_CHANNELS: Mapping[str, int] = {"geometry": 3, "albedo": 3}
"""Outputs of a trained decoder per pixel, by factor: position on the object across and down, and depth; red,
green, blue (training/unets.py)."""

LEVELS_KEPT = 2
"""Levels, finest first, whose BatchNorm keeps its statistics in encoders and a decoder trained together."""


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


class SegmentationNet(nn.Module):
    """Images in 0..1 to one logit a class and pixel, from U-Net encoders and a decoder over all of them.

    ``frozen`` encoders never change. With ``kept_statistics`` their BatchNorm keeps its statistics in
    training, too; beside a learnt ``decoder``, of which all but the last layer is taken, that of the two
    finest levels of either.
    """

    def __init__(
        self,
        encoders: Sequence[UNetEncoder],
        outputs: int,
        *,
        frozen: bool = False,
        kept_statistics: bool = False,
        decoder: UNetDecoder | None = None,
    ):
        super().__init__()
        widths = {tuple(encoder.widths) for encoder in encoders}
        if len(widths) != 1:
            raise ValueError(
                f"encoders of one net have the same widths, got {sorted(widths) or 'no encoder'}"
            )
        self.encoders = nn.ModuleList(encoders).requires_grad_(not frozen)
        for encoder in encoders:
            encoder.to_code.requires_grad_(False)  # the code takes no part here
        if decoder is None:
            self.decoder = UNetDecoder(widths.pop(), len(encoders), outputs)
        else:
            self.decoder = copy.deepcopy(decoder).requires_grad_(True)
            last = decoder.to_outputs
            self.decoder.to_outputs = nn.Conv2d(last.in_channels, outputs, 1, device=last.weight.device)
        self.frozen, self.kept_statistics = frozen, frozen or kept_statistics
        self._fixed: list[nn.Module] = []  # parts whose BatchNorm keeps its statistics
        if self.kept_statistics:
            finest = [encoder.levels[:LEVELS_KEPT] for encoder in encoders]
            self._fixed += [self.encoders] if frozen or decoder is None else finest
            self._fixed += [] if decoder is None else [self.decoder.convolve[-LEVELS_KEPT:]]

    def train(self, mode: bool = True) -> "SegmentationNet":
        super().train(mode)
        for part in self._fixed:
            part.eval()
        return self

    def forward(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n outputs h w"]:
        with torch.set_grad_enabled(torch.is_grad_enabled() and not self.frozen):
            levels = zip(*(encoder.skips(images) for encoder in self.encoders), strict=True)  # type: ignore[operator]
            joined = [torch.cat(level, dim=1) for level in levels]
        return self.decoder(joined)
