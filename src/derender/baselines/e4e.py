"""e4e: an encoder from an image to the W+ code of a StyleGAN2 generator that stays as it is.

Source: Tov et al., *Designing an Encoder for StyleGAN Image Manipulation* (SIGGRAPH 2021). The body is
ArcFace's, an improved residual net with squeeze-and-excitation. The heads are pSp's (Richardson et al., CVPR
2021): maps at 1/16, 1/8 and 1/4 of the image feed 3 coarse, 4 middle and all finer codes. The first head
gives one code for all layers, the others what each adds to it; the generator's mean code is added at the end.

Losses: squared error and perceptual distance (features learnt without labels from the same images) between
image and inversion. Codes are released one after the other, and their difference from the first is kept
small. Instead of e4e's discriminator of codes the first code is drawn towards the mean code. Leaves out the
identity loss, which needs a face recogniser.
"""

from collections.abc import Callable
from itertools import pairwise
from math import log2
from pathlib import Path
from typing import Any, Literal

import torch
from pydantic import Field, PositiveInt
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d, interpolate, leaky_relu, mse_loss

from derender.baselines.generator import Codes, EqualLinear, Generator, GeneratorSettings, Side
from derender.baselines.model import BaselineConfig, BaselineSettings, Features, Images, LoopModel, LossInputs
from derender.baselines.stylegan2 import CENTRE_LATENTS, Stylegan
from derender.settings import Settings
from derender.training.batches import random_stream

FIRST_MIDDLE, FIRST_FINE = 3, 7  # numbers of the codes


class EncoderSettings(BaselineSettings):
    """Sizes; the defaults are small. The published encoder has 256, 64, (3, 4, 14, 3) and 16."""

    image_size: Side = Field(default=64, ge=32)
    width: int = Field(default=16, ge=1)
    units: tuple[PositiveInt, PositiveInt, PositiveInt, PositiveInt] = (1, 1, 2, 1)
    reduction: int = Field(default=4, ge=1)


class E4eSettings(EncoderSettings):
    """The encoder's sizes and those of the generator whose codes it gives."""

    generator: GeneratorSettings = GeneratorSettings()


class InversionObjective(Settings):
    """Which generator, the weights of the terms, and when which code may differ from the first."""

    generator: str | None = None  # run folder of a stylegan2
    perceptual_weight: float = Field(default=0.8, ge=0)
    delta_weight: float = Field(default=5e-5, ge=0)  # the original's 2e-4, whose images are -1..1
    prior_weight: float = Field(default=1e-4, ge=0)  # a random code is about 42 (squared) from the mean code
    first_release: int = Field(default=10_000, ge=0)  # images until then all layers share one code
    release_every: int = Field(default=2_000, ge=1)  # images from one code to the next
    self_features_steps: int = Field(default=600, ge=1)


class E4eConfig(BaselineConfig):
    """One training run of an e4e encoder."""

    baseline: Literal["e4e"] = "e4e"
    model: EncoderSettings = EncoderSettings()
    objective: InversionObjective = InversionObjective()
    batch_size: int = Field(default=16, ge=2)
    channels_last: bool = False


class Unit(nn.Module):
    """Two 3x3 convolutions with a gate for each channel, and a shortcut; ``stride`` is the second's."""

    def __init__(self, inputs: int, outputs: int, stride: int, reduction: int):
        super().__init__()
        same, narrow = inputs == outputs, max(1, outputs // reduction)
        self.shortcut = nn.MaxPool2d(1, stride) if same else nn.Conv2d(inputs, outputs, 1, stride, bias=False)
        self.shortcut_norm = nn.Identity() if same else nn.BatchNorm2d(outputs)
        self.norm = nn.BatchNorm2d(inputs)
        self.first = nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)
        self.active = nn.PReLU(outputs)
        self.second = nn.Conv2d(outputs, outputs, 3, stride, padding=1, bias=False)
        self.last_norm = nn.BatchNorm2d(outputs)
        self.squeeze = nn.Conv2d(outputs, narrow, 1, bias=False)
        self.excite = nn.Conv2d(narrow, outputs, 1, bias=False)

    def forward(self, maps: Tensor) -> Tensor:
        passed = self.shortcut_norm(self.shortcut(maps))
        change = self.last_norm(self.second(self.active(self.first(self.norm(maps)))))
        gate = self.excite(self.squeeze(adaptive_avg_pool2d(change, 1)).relu()).sigmoid()
        return change * gate + passed


class Head(nn.Module):
    """A square map to one code: strided convolutions to 1x1, then a linear layer."""

    def __init__(self, inputs: int, outputs: int, side: int):
        super().__init__()
        widths = [inputs, *[outputs] * int(log2(side))]
        self.convs = nn.ModuleList(nn.Conv2d(*pair, 3, 2, padding=1) for pair in pairwise(widths))
        self.linear = EqualLinear(outputs, outputs)

    def forward(self, maps: Tensor) -> Tensor:
        for conv in self.convs:
            maps = leaky_relu(conv(maps))
        return self.linear(maps.flatten(1))


class E4eEncoder(nn.Module):
    """Image in -1..1 to W+ less the mean code."""

    def __init__(self, settings: EncoderSettings, codes: int, style_size: int):
        super().__init__()
        width, side = settings.width, settings.image_size
        widths = (width, width, 2 * width, 4 * width, 8 * width)
        self.stem = nn.Conv2d(3, width, 3, padding=1, bias=False)
        self.stem_norm, self.stem_active = nn.BatchNorm2d(width), nn.PReLU(width)
        self.doubled = nn.UpsamplingBilinear2d(scale_factor=2)
        self.stages = nn.ModuleList()
        for (before, after), count in zip(pairwise(widths), settings.units, strict=True):
            rest = (Unit(after, after, 1, settings.reduction) for _ in range(count - 1))
            self.stages.append(nn.Sequential(Unit(before, after, 2, settings.reduction), *rest))
        self.to_middle = nn.Conv2d(widths[3], widths[4], 1)
        self.to_fine = nn.Conv2d(widths[2], widths[4], 1)
        strides = [16 if code < FIRST_MIDDLE else 8 if code < FIRST_FINE else 4 for code in range(codes)]
        self.heads = nn.ModuleList(Head(widths[4], style_size, side // stride) for stride in strides)

    def forward(self, images: Images, *, released: int) -> Codes:
        """``released``: the number of the last code that may differ from the first; at 0 all are the same."""
        half, quarter, eighth, sixteenth = self.stages
        at_4 = quarter(half(self.stem_active(self.stem_norm(self.stem(images)))))
        at_8 = eighth(at_4)
        coarse = sixteenth(at_8)
        middle = self.doubled(coarse) + self.to_middle(at_8)
        fine = self.doubled(middle) + self.to_fine(at_4)
        sources = [coarse] * FIRST_MIDDLE + [middle] * (FIRST_FINE - FIRST_MIDDLE) + [fine] * len(self.heads)
        first, *added = (head(maps) for head, maps in zip(self.heads[: released + 1], sources, strict=False))
        same = len(self.heads) - 1 - len(added)
        return torch.stack([first, *(first + change for change in added), *[first] * same], dim=1)


class E4e(LoopModel):
    """Encoder and the generator that it inverts. Feature: ``w+``, flattened (9,216 at 1024 pixels)."""

    name, settings_type, config_type = "e4e", E4eSettings, E4eConfig
    features = ("w+",)
    given_as = ", for ris as --set e4e=RUN"
    not_judged = ("delta", "prior")
    settings: E4eSettings
    centre: Tensor
    seen: Tensor
    released: Tensor

    def __init__(self, settings: E4eSettings):
        super().__init__(settings)
        codes, size = settings.generator.codes, settings.generator.style_size
        self.encoder = E4eEncoder(settings, codes, size)
        self.generator = Generator(settings.generator).requires_grad_(False)
        self.register_buffer("centre", torch.zeros(codes, size))
        self.register_buffer("seen", torch.zeros((), dtype=torch.int64))  # images learnt from
        self.register_buffer("released", torch.tensor(codes))

    @classmethod
    def open(cls, source: str | Path | None, *, image_size: int | None = None, seed: int = 0) -> Any:
        """The encoder of a run, for images of its size or smaller ones; see `open_baseline`."""
        net = super().open(source)
        net.image_size = image_size or net.image_size
        return net

    @classmethod
    def build(cls, config: E4eConfig) -> "E4e":
        """The untrained encoder with the generator that the configuration names and its mean code."""
        generator = Stylegan.open(config.objective.generator).generator
        model = cls(E4eSettings(**config.model.model_dump(), generator=generator.settings))
        model.generator.load_state_dict(generator.state_dict())
        model.released.fill_(0)
        latents = generator.random_w(CENTRE_LATENTS, random_stream(config.seed, "perturb", 0))
        model.centre.copy_(latents.mean(dim=0).expand_as(model.centre))
        return model

    @staticmethod
    def prepare(config: E4eConfig, device: torch.device, perceptual: Callable[[], Any]) -> Any:
        """Features learnt from the images; None if they have no weight."""
        return perceptual() if config.objective.perceptual_weight else None

    def invert(self, images: Images) -> Codes:
        """W+ of images in 0..1, which are enlarged to the encoder's size where they are smaller."""
        if images.shape[-1] != self.settings.image_size:
            images = interpolate(images, self.settings.image_size, mode="bilinear", align_corners=False)
        return self.encoder(2 * images - 1, released=int(self.released)) + self.centre

    def rebuild(self, w_plus: Codes) -> Images:
        """The generator's images, about 0..1, with the noise stored with its weights."""
        return self.generator(w_plus, self.generator.fixed_noise()) / 2 + 0.5

    def describe(self, images: Images) -> Features:
        return {"w+": self.invert(images).flatten(1)}

    def shown(self, images: Images) -> dict[str, Images]:
        again = adaptive_avg_pool2d(self.rebuild(self.invert(images)), images.shape[-1])
        return {"input": images, "inversion": again.clamp(0, 1)}

    def losses(self, images: Images, run: LossInputs) -> dict[str, Tensor]:
        """Squared error and perceptual distance of inversions in 0..1, two regularisers; beside them L1.

        After ``first_release`` images the second code may differ from the first, then one more at a time.
        """
        objective: InversionObjective = run.config.objective
        if self.training:
            free = int(self.seen) - objective.first_release
            self.released.fill_(max(0, free // objective.release_every + 1))
            self.seen += len(images)
        with run.precision():
            w_plus = self.invert(images)
            again = self.rebuild(w_plus)
        difference = w_plus[:, 1:] - w_plus[:, :1]
        again = adaptive_avg_pool2d(again.float(), images.shape[-1])
        terms = {
            "reconstruction": mse_loss(again, images),
            "delta": objective.delta_weight * (difference.square().sum(2) + 1e-12).sqrt().sum(1).mean(),
            "prior": objective.prior_weight * (w_plus[:, 0] - self.centre[0]).square().sum(dim=1).mean(),
            "l1": (again.detach().clamp(0, 1) - images).abs().mean(),
        }
        if run.aid is not None:
            distance = mse_loss(run.aid(again), run.aid(images))
            terms["perceptual"] = objective.perceptual_weight * distance
        return terms
