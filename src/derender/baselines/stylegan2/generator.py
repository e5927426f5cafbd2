"""StyleGAN2's generator: z to w to styles to a picture, to 1024 pixels.

Source: Karras et al. (CVPR 2020): a mapping network of equalised layers, a learnt 4x4 constant, two styled
convolutions at every resolution (the first doubles it), and a picture that is summed up by skips.
Configuration F has min(512, 32768 / resolution) channels. Pictures are about -1..1 and not clipped.

Three kinds of codes steer it: w (one vector), W+ (one w for each depth, 18 at 1024 pixels), and style space:
what the layers' affine maps make of W+, one number for each input channel of each layer, those that make
colours included (9,088 at 1024 pixels). Leaves out progressive growing and class labels.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import log2

import torch
from jaxtyping import Float
from pydantic import Field, field_validator
from torch import Generator as RandomGenerator
from torch import Tensor, nn

from derender.baselines.model import BaselineSettings
from derender.baselines.stylegan2.layers import EqualLinear, StyledConv, ToRgb, pixel_norm

SMALLEST, LARGEST = 8, 1024
Noise = Sequence[Tensor] | None
"""One (m, 1, r, r) map for every styled convolution, m = 1 or the number of pictures; None is no noise."""
Watch = Callable[[int, Tensor], None]
"""Told the number of a style and the (n, channels, r, r) activation that it scales."""


class GeneratorSettings(BaselineSettings):
    """Sizes; the defaults are small. ``config_f`` gives those of the published networks."""

    image_size: int = 64
    style_size: int = Field(default=128, ge=1)
    mapping_layers: int = Field(default=8, ge=1)
    mapping_rate: float = Field(default=0.01, gt=0)
    channel_base: int = Field(default=2048, ge=32)  # channels times resolution
    channel_max: int = Field(default=64, ge=1)

    @field_validator("image_size")
    @classmethod
    def _power_of_two(cls, value: int) -> int:
        if not (SMALLEST <= value <= LARGEST and value.bit_count() == 1):
            raise ValueError(f"StyleGAN2 makes pictures of 8, 16, 32, ... 1024 pixels, not {value}")
        return value

    def channels(self, resolution: int) -> int:
        """Width of the layers at a resolution."""
        return max(1, min(self.channel_max, self.channel_base // resolution))

    @property
    def resolutions(self) -> tuple[int, ...]:
        """4, 8, ... to the picture's."""
        return tuple(2**power for power in range(2, int(log2(self.image_size)) + 1))

    @property
    def codes(self) -> int:
        """How many w a W+ code has: 18 at 1024 pixels, two fewer at each half."""
        return 2 * len(self.resolutions)


def config_f(image_size: int) -> GeneratorSettings:
    """The published networks' sizes."""
    return GeneratorSettings(
        image_size=image_size, style_size=512, mapping_layers=8, channel_base=32_768, channel_max=512
    )


@dataclass(frozen=True)
class StyleLayer:
    """One layer that a style steers.

    Attributes:
        colour: whether it makes colours (ToRGB) or is a styled convolution.
        index: which of its kind.
        code: the w of W+ that it takes.
        resolution: of the activation that the style scales, in pixels.
        channels: numbers in its style.
    """

    colour: bool
    index: int
    code: int
    resolution: int
    channels: int


def style_layers(settings: GeneratorSettings) -> tuple[StyleLayer, ...]:
    """Every steered layer in the order in which a picture is made: style space's order."""
    channels, sizes = settings.channels, settings.resolutions
    found = [StyleLayer(False, 0, 0, 4, channels(4)), StyleLayer(True, 0, 1, 4, channels(4))]
    for step, (half, size) in enumerate(pairwise(sizes)):
        first = 2 * step + 1
        found += [
            StyleLayer(False, first, first, half, channels(half)),
            StyleLayer(False, first + 1, first + 1, size, channels(size)),
            StyleLayer(True, step + 1, first + 2, size, channels(size)),
        ]
    return tuple(found)


class Mapping(nn.Module):
    """z to w: a pixel norm and equalised layers with a small rate."""

    def __init__(self, settings: GeneratorSettings):
        super().__init__()
        size, rate = settings.style_size, settings.mapping_rate
        self.layers = nn.ModuleList(
            EqualLinear(size, size, rate=rate, active=True) for _ in range(settings.mapping_layers)
        )

    def forward(self, z: Float[Tensor, "n d"]) -> Float[Tensor, "n d"]:
        w = pixel_norm(z)
        for layer in self.layers:
            w = layer(w)
        return w


class Generator(nn.Module):
    """Mapping and synthesis. ``layers`` says what each style steers."""

    def __init__(self, settings: GeneratorSettings):
        super().__init__()
        self.settings, self.layers = settings, style_layers(settings)
        channels, size = settings.channels, settings.style_size
        self.mapping = Mapping(settings)
        self.constant = nn.Parameter(torch.randn(1, channels(4), 4, 4))
        convs, colours = [StyledConv(channels(4), channels(4), size, resample="none")], [channels(4)]
        for half, whole in pairwise(settings.resolutions):
            convs.append(StyledConv(channels(half), channels(whole), size, resample="up"))
            convs.append(StyledConv(channels(whole), channels(whole), size, resample="none"))
            colours.append(channels(whole))
        self.convs = nn.ModuleList(convs)
        self.to_rgbs = nn.ModuleList(ToRgb(width, size) for width in colours)
        for index, side in enumerate(self.noise_sizes):
            self.register_buffer(f"noise_{index}", torch.randn(1, 1, side, side))

    @property
    def noise_sizes(self) -> tuple[int, ...]:
        """Side of the noise map of every styled convolution."""
        return (4, *(side for size in self.settings.resolutions[1:] for side in (size, size)))

    def fixed_noise(self) -> tuple[Tensor, ...]:
        """The maps that lie with the weights."""
        return tuple(self.get_buffer(f"noise_{index}") for index in range(len(self.noise_sizes)))

    def random_noise(self, count: int, generator: RandomGenerator) -> tuple[Tensor, ...]:
        """Fresh maps for ``count`` pictures."""
        return tuple(
            torch.randn(count, 1, side, side, generator=generator).to(self.constant)
            for side in self.noise_sizes
        )

    def random_z(self, count: int, generator: RandomGenerator) -> Float[Tensor, "n d"]:
        """Standard normal latents."""
        return torch.randn(count, self.settings.style_size, generator=generator).to(self.constant)

    @torch.no_grad()
    def mean_w(self, count: int, generator: RandomGenerator) -> Float[Tensor, " d"]:
        """The centre that truncation pulls to, from ``count`` latents."""
        return self.mapping(self.random_z(count, generator)).mean(dim=0)

    def w_plus(self, w: Float[Tensor, "n d"] | Float[Tensor, "n codes d"]) -> Float[Tensor, "n codes d"]:
        """One w for all layers, or W+ as it is.

        Raises:
            ValueError: another number of codes, or of another length.
        """
        codes, size = self.settings.codes, self.settings.style_size
        found = w[:, None].expand(-1, codes, -1) if w.ndim == 2 else w
        if tuple(found.shape[1:]) != (codes, size):
            raise ValueError(
                f"this generator takes w of {size} numbers or W+ of {codes} x {size}, "
                f"got {tuple(w.shape[1:])}"
            )
        return found

    def styles(self, w_plus: Float[Tensor, "n codes d"]) -> list[Float[Tensor, "n _"]]:
        """Style space, one matrix for each steered layer."""
        return [self._module(layer).affine(w_plus[:, layer.code]) for layer in self.layers]

    def split_styles(self, flat: Float[Tensor, "n s"]) -> list[Float[Tensor, "n _"]]:
        """Style space cut into layers; ``torch.cat(styles, dim=1)`` is the way back."""
        return list(flat.split([layer.channels for layer in self.layers], dim=1))

    def synthesise(
        self, styles: Sequence[Float[Tensor, "n _"]], noise: Noise = None, *, watch: Watch | None = None
    ) -> Float[Tensor, "n 3 h w"]:
        """A picture, about -1..1, from one style for each layer."""
        images, picture = self.constant.expand(len(styles[0]), -1, -1, -1), None
        for number, (layer, style) in enumerate(zip(self.layers, styles, strict=True)):
            if watch is not None:
                watch(number, images)
            module = self._module(layer)
            if layer.colour:
                picture = module(images, style, picture)
            else:
                images = module(images, style, None if noise is None else noise[layer.index])
        assert picture is not None
        return picture

    def forward(
        self, w: Float[Tensor, "n d"] | Float[Tensor, "n codes d"], noise: Noise = None
    ) -> Float[Tensor, "n 3 h w"]:
        """A picture, about -1..1, from w or W+."""
        return self.synthesise(self.styles(self.w_plus(w)), noise)

    def _module(self, layer: StyleLayer) -> StyledConv | ToRgb:
        return (self.to_rgbs if layer.colour else self.convs)[layer.index]  # pyright: ignore[reportReturnType]


def truncate(
    w: Float[Tensor, "n *rest d"], centre: Float[Tensor, " d"], strength: float
) -> Float[Tensor, "n *rest d"]:
    """w pulled to the centre: 1 leaves it, 0 makes it the centre."""
    return torch.lerp(centre.expand_as(w), w, strength)
