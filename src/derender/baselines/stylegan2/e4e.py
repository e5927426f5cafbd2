"""e4e: an encoder from a picture to the W+ code of a StyleGAN2 generator.

Source: Tov et al., *Designing an Encoder for StyleGAN Image Manipulation* (SIGGRAPH 2021), whose body is that
of ArcFace (an improved residual net with squeeze-and-excitation, 50 layers) and whose heads are pSp's
(Richardson et al., CVPR 2021): maps at 1/16, 1/8 and 1/4 of the picture feed 3 coarse, 4 middle and all finer
codes. The first head gives one code for all layers, the others what each adds to it, and the generator's mean
code is added at the end. The published network takes 256 pixels and gives 18 x 512 numbers. Leaves out how it
learns (inversion.py).
"""

from itertools import pairwise
from math import log2

import torch
from jaxtyping import Float
from pydantic import Field, field_validator
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d, interpolate, leaky_relu

from derender.baselines.model import BaselineModel, BaselineSettings
from derender.baselines.stylegan2.generator import Generator, GeneratorSettings
from derender.baselines.stylegan2.layers import EqualLinear

FIRST_MIDDLE, FIRST_FINE = 3, 7  # numbers of the codes


class EncoderSettings(BaselineSettings):
    """Sizes; the defaults are small. The published encoder has 256, 64, (3, 4, 14, 3) and 16."""

    image_size: int = 64
    width: int = Field(default=16, ge=1)
    units: tuple[int, int, int, int] = (1, 1, 2, 1)
    reduction: int = Field(default=4, ge=1)

    @field_validator("image_size")
    @classmethod
    def _power_of_two(cls, value: int) -> int:
        if value < 32 or value.bit_count() != 1:
            raise ValueError(f"e4e takes pictures of 32, 64, 128, 256, ... pixels, not {value}")
        return value

    @field_validator("units")
    @classmethod
    def _some_units(cls, value: tuple[int, int, int, int]) -> tuple[int, int, int, int]:
        if min(value) < 1:
            raise ValueError(f"every stage needs at least one unit, got {value}")
        return value


class E4eSettings(EncoderSettings):
    """The encoder's sizes and those of the generator whose codes it gives."""

    generator: GeneratorSettings = GeneratorSettings()


class Unit(nn.Module):
    """Two 3x3 convolutions with a gate for each channel, and a shortcut; ``stride`` is the second's."""

    def __init__(self, inputs: int, outputs: int, stride: int, reduction: int):
        super().__init__()
        same = inputs == outputs
        self.shortcut = None if same else nn.Conv2d(inputs, outputs, 1, stride, bias=False)
        self.shortcut_norm = None if same else nn.BatchNorm2d(outputs)
        self.norm = nn.BatchNorm2d(inputs)
        self.first = nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)
        self.active = nn.PReLU(outputs)
        self.second = nn.Conv2d(outputs, outputs, 3, stride, padding=1, bias=False)
        self.last_norm = nn.BatchNorm2d(outputs)
        narrow = max(1, outputs // reduction)
        self.squeeze = nn.Conv2d(outputs, narrow, 1, bias=False)
        self.excite = nn.Conv2d(narrow, outputs, 1, bias=False)
        self.stride = stride

    def forward(self, maps: Float[Tensor, "n i h w"]) -> Float[Tensor, "n o h2 w2"]:
        if self.shortcut is None or self.shortcut_norm is None:
            kept = maps[:, :, :: self.stride, :: self.stride]
        else:
            kept = self.shortcut_norm(self.shortcut(maps))
        found = self.last_norm(self.second(self.active(self.first(self.norm(maps)))))
        gate = self.excite(self.squeeze(adaptive_avg_pool2d(found, 1)).relu()).sigmoid()
        return found * gate + kept


class Head(nn.Module):
    """A square map to one code: strided convolutions to 1x1, then a linear layer."""

    def __init__(self, inputs: int, outputs: int, side: int):
        super().__init__()
        widths = [inputs, *[outputs] * int(log2(side))]
        self.convs = nn.ModuleList(
            nn.Conv2d(before, after, 3, 2, padding=1) for before, after in pairwise(widths)
        )
        self.linear = EqualLinear(outputs, outputs)

    def forward(self, maps: Float[Tensor, "n i s s"]) -> Float[Tensor, "n o"]:
        for conv in self.convs:
            maps = leaky_relu(conv(maps))
        return self.linear(maps.flatten(1))


class Encoder(nn.Module):
    """Picture in -1..1 to W+ less the mean code."""

    def __init__(self, settings: EncoderSettings, codes: int, style_size: int):
        super().__init__()
        width, side = settings.width, settings.image_size
        widths = (width, width, 2 * width, 4 * width, 8 * width)
        self.stem = nn.Conv2d(3, width, 3, padding=1, bias=False)
        self.stem_norm, self.stem_active = nn.BatchNorm2d(width), nn.PReLU(width)
        self.stages = nn.ModuleList(
            nn.Sequential(
                *(
                    Unit(before if i == 0 else after, after, 2 if i == 0 else 1, settings.reduction)
                    for i in range(count)
                )
            )
            for before, after, count in zip(widths[:-1], widths[1:], settings.units, strict=True)
        )
        self.to_middle = nn.Conv2d(widths[3], widths[4], 1)
        self.to_fine = nn.Conv2d(widths[2], widths[4], 1)
        self.heads = nn.ModuleList(
            Head(widths[4], style_size, side // self._stride(code)) for code in range(codes)
        )

    @staticmethod
    def _stride(code: int) -> int:
        return 16 if code < FIRST_MIDDLE else 8 if code < FIRST_FINE else 4

    def forward(self, images: Float[Tensor, "n 3 h w"], *, released: int) -> Float[Tensor, "n codes d"]:
        """``released``: the number of the last code that may differ from the first; at 0 all are the same."""
        maps = self.stem_active(self.stem_norm(self.stem(images)))
        half, quarter, eighth, sixteenth = self.stages
        at_4 = quarter(half(maps))
        at_8 = eighth(at_4)
        coarse = sixteenth(at_8)
        middle = enlarged(coarse, at_8) + self.to_middle(at_8)
        fine = enlarged(middle, at_4) + self.to_fine(at_4)
        first = self.heads[0](coarse)
        codes = [first]
        for code, head in enumerate(list(self.heads)[1:], 1):
            if code > released:
                codes.append(first)
                continue
            source = coarse if code < FIRST_MIDDLE else middle if code < FIRST_FINE else fine
            codes.append(first + head(source))
        return torch.stack(codes, dim=1)


def enlarged(maps: Float[Tensor, "n c h w"], like: Float[Tensor, "n d h2 w2"]) -> Float[Tensor, "n c h2 w2"]:
    """Bilinear, corners on corners."""
    return interpolate(maps, like.shape[-2:], mode="bilinear", align_corners=True)


class E4e(BaselineModel):
    """Encoder and the generator that it inverts. Feature: ``w+``, flattened (9,216 at 1024 pixels)."""

    name = "e4e"
    features = ("w+",)
    settings: E4eSettings
    centre: Tensor
    seen: Tensor
    released: Tensor

    def __init__(self, settings: E4eSettings):
        super().__init__(settings)
        codes, size = settings.generator.codes, settings.generator.style_size
        self.encoder = Encoder(settings, codes, size)
        self.generator = Generator(settings.generator).requires_grad_(False)
        self.register_buffer("centre", torch.zeros(codes, size))
        self.register_buffer("seen", torch.zeros((), dtype=torch.int64))  # pictures learnt from
        self.register_buffer("released", torch.tensor(codes))

    def invert(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n codes d"]:
        """W+ of pictures in 0..1."""
        return self.encoder(2 * images - 1, released=int(self.released)) + self.centre

    def rebuild(self, w_plus: Float[Tensor, "n codes d"]) -> Float[Tensor, "n 3 h w"]:
        """The generator's pictures, about 0..1, with the noise that lies with its weights."""
        return self.generator(w_plus, self.generator.fixed_noise()) / 2 + 0.5

    def describe(self, images: Float[Tensor, "n 3 h w"]) -> dict[str, Float[Tensor, "n _"]]:
        return {"w+": self.invert(images).flatten(1)}

    def shown(self, images: Float[Tensor, "n 3 h w"]) -> dict[str, Float[Tensor, "n 3 h w"]]:
        again = adaptive_avg_pool2d(self.rebuild(self.invert(images)), images.shape[-1])
        return {"input": images, "inversion": again.clamp(0, 1)}
