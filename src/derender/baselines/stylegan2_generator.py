"""StyleGAN2's generator in plain torch: z to w to styles to an image, to 1024 pixels.

Source: Karras et al., *Analyzing and Improving the Image Quality of StyleGAN* (CVPR 2020); equalised learning
rates and the pixel norm are those of *Progressive Growing of GANs* (ICLR 2018). Configuration F has
min(512, 32768 / resolution) channels. Images are about -1..1 and not clipped.

Three kinds of codes steer the generator: w (one vector), W+ (one w for each depth, 18 at 1024 pixels), and
style space: the output of the layers' affine maps on W+, one number for each input channel of each layer,
colour layers included (9,088 at 1024 pixels). A style scales the inputs of a convolution and its norm divides
the outputs: the paper's modulated and demodulated weight without one weight per image. Leaves out compiled
kernels, half precision, progressive growing and class labels.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import log2, sqrt

import torch
from jaxtyping import Float
from pydantic import Field, field_validator
from torch import Generator as RandomGenerator
from torch import Tensor, nn
from torch.nn.functional import conv2d, conv_transpose2d, leaky_relu, linear

from derender.baselines.model import BaselineSettings, Images

SMALLEST, LARGEST = 8, 1024
FILTER = (0.125, 0.375, 0.375, 0.125)
"""Binomial taps that every change of resolution goes through; they add up to 1."""
TINY = 1e-8
SLOPE, GAIN = 0.2, sqrt(2)
"""Of the leaky ReLU, and the gain that keeps its output's variance about 1."""

Noise = Sequence[Tensor] | None
"""One (m, 1, r, r) map for every styled convolution, m = 1 or the number of images; None is no noise."""
Watch = Callable[[int, Tensor], None]
"""Called with the number of a style and the (n, channels, r, r) activation that it scales."""


class GeneratorSettings(BaselineSettings):
    """Sizes; the defaults are small. The published FFHQ network has 1024, 512, 8, 0.01, 32768 and 512."""

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
            raise ValueError(f"StyleGAN2 makes images of 8, 16, 32, ... 1024 pixels, not {value}")
        return value

    def channels(self, resolution: int) -> int:
        """Width of the layers at a resolution."""
        return max(1, min(self.channel_max, self.channel_base // resolution))

    @property
    def resolutions(self) -> tuple[int, ...]:
        """4, 8, ... to the image's."""
        return tuple(2**power for power in range(2, int(log2(self.image_size)) + 1))

    @property
    def codes(self) -> int:
        """How many w a W+ code has: 18 at 1024 pixels, two fewer at each half."""
        return 2 * len(self.resolutions)


def upfirdn(
    images: Float[Tensor, "n c h w"],
    taps: Float[Tensor, " k"],
    *,
    up: int = 1,
    padding: tuple[int, int] = (0, 0),
) -> Float[Tensor, "n c h2 w2"]:
    """Put ``up - 1`` zeros after each pixel, pad, and convolve along both axes.

    As scipy.signal.upfirdn along each axis; ``padding`` is counted after the zeros, before and behind, and
    cuts where it is negative. Zeros lie outside.
    """
    rows, columns = (_band(side, taps, up, padding) for side in images.shape[2:])
    return rows.T @ (images @ columns)


def _band(
    side: int, taps: Float[Tensor, " k"], up: int, padding: tuple[int, int]
) -> Float[Tensor, "side outputs"]:
    """The resampling of one axis as a matrix; on a CPU a product is faster than shifted sums."""
    starts = torch.arange(side * up + sum(padding) - len(taps) + 1, device=taps.device) - padding[0]
    tap = len(taps) - 1 + starts - up * torch.arange(side, device=taps.device)[:, None]
    inside = (tap >= 0) & (tap < len(taps))
    return torch.where(inside, taps[tap.clamp(0, len(taps) - 1)], 0.0)


class EqualLinear(nn.Module):
    """A linear layer whose weights are stored with unit variance over ``rate`` and scaled when used.

    ``rate`` multiplies the effective learning rate; ``active`` adds the leaky ReLU with its gain.
    """

    def __init__(
        self, inputs: int, outputs: int, *, start: float = 0.0, rate: float = 1.0, active: bool = False
    ):
        super().__init__()
        self.weight = nn.Parameter(torch.randn(outputs, inputs) / rate)
        self.bias = nn.Parameter(torch.full((outputs,), start))
        self.scale, self.rate, self.active = rate / sqrt(inputs), rate, active

    def forward(self, values: Float[Tensor, "n i"]) -> Float[Tensor, "n o"]:
        made = linear(values, self.weight * self.scale, self.bias * self.rate)
        return leaky_relu(made, SLOPE) * GAIN if self.active else made


def modulated_conv(
    images: Float[Tensor, "n i h w"],
    weight: Float[Tensor, "o i k k"],
    style: Float[Tensor, "n i"],
    *,
    demodulate: bool,
    taps: Float[Tensor, " t"] | None = None,
) -> Float[Tensor, "n o h2 w2"]:
    """Convolve with ``weight`` whose input channels are scaled by each image's style.

    With ``demodulate`` every image's kernel of an output channel has norm 1, so inputs of variance 1 give
    outputs of variance 1 and the style's length does not matter. With ``taps`` the image becomes twice as
    large: a transposed convolution of stride 2, then the filter.
    """
    weight = weight / sqrt(weight[0].numel())
    made = images * style[:, :, None, None]
    if taps is None:
        made = conv2d(made, weight, padding=weight.shape[-1] // 2)
    else:
        made = upfirdn(conv_transpose2d(made, weight.transpose(0, 1), stride=2), 2 * taps, padding=(1, 1))
    if not demodulate:
        return made
    norm = style.square() @ weight.square().sum(dim=(2, 3)).T
    return made * (norm + TINY).rsqrt()[:, :, None, None]


class ModulatedConv(nn.Module):
    """A convolution and the affine map from w to its style; see ``modulated_conv``."""

    taps: Tensor

    def __init__(
        self, inputs: int, outputs: int, kernel: int, style_size: int, *, demodulate: bool, up: bool
    ):
        super().__init__()
        self.weight = nn.Parameter(torch.randn(outputs, inputs, kernel, kernel))
        self.affine = EqualLinear(style_size, inputs, start=1.0)
        self.demodulate, self.up = demodulate, up
        self.register_buffer("taps", torch.tensor(FILTER), persistent=False)

    def forward(self, images: Tensor, style: Tensor) -> Float[Tensor, "n o h w"]:
        taps = self.taps if self.up else None
        return modulated_conv(images, self.weight, style, demodulate=self.demodulate, taps=taps)


class StyledConv(ModulatedConv):
    """Modulated 3x3 convolution, noise of a learnt strength, bias, leaky ReLU; ``up`` doubles the size."""

    def __init__(self, inputs: int, outputs: int, style_size: int, *, up: bool = False):
        super().__init__(inputs, outputs, 3, style_size, demodulate=True, up=up)
        self.noise_strength = nn.Parameter(torch.zeros(1))
        self.bias = nn.Parameter(torch.zeros(outputs))

    def forward(
        self, images: Tensor, style: Tensor, noise: Float[Tensor, "m 1 h w"] | None = None
    ) -> Float[Tensor, "n o h w"]:
        made = super().forward(images, style)
        if noise is not None:
            made = made + self.noise_strength * noise
        return leaky_relu(made + self.bias[:, None, None], SLOPE) * GAIN


class ToRgb(ModulatedConv):
    """Modulated 1x1 convolution to three channels, not demodulated, added to the enlarged image so far."""

    def __init__(self, inputs: int, style_size: int):
        super().__init__(inputs, 3, 1, style_size, demodulate=False, up=False)
        self.bias = nn.Parameter(torch.zeros(3))

    def forward(
        self, images: Tensor, style: Tensor, before: Float[Tensor, "n 3 h w"] | None = None
    ) -> Float[Tensor, "n 3 h2 w2"]:
        made = super().forward(images, style) + self.bias[:, None, None]
        return made if before is None else made + upfirdn(before, 2 * self.taps, up=2, padding=(2, 1))


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
    """Every steered layer in the order in which an image is made: style space's order."""
    channels = settings.channels
    layers = [StyleLayer(False, 0, 0, 4, channels(4)), StyleLayer(True, 0, 1, 4, channels(4))]
    for step, (half, size) in enumerate(pairwise(settings.resolutions)):
        first = 2 * step + 1
        layers += [
            StyleLayer(False, first, first, half, channels(half)),
            StyleLayer(False, first + 1, first + 1, size, channels(size)),
            StyleLayer(True, step + 1, first + 2, size, channels(size)),
        ]
    return tuple(layers)


class Mapping(nn.Module):
    """z to w: every z divided by its root mean square, then equalised layers with a small rate."""

    def __init__(self, settings: GeneratorSettings):
        super().__init__()
        size, rate = settings.style_size, settings.mapping_rate
        self.layers = nn.ModuleList(
            EqualLinear(size, size, rate=rate, active=True) for _ in range(settings.mapping_layers)
        )

    def forward(self, z: Float[Tensor, "n d"]) -> Float[Tensor, "n d"]:
        w = z * (z.square().mean(dim=1, keepdim=True) + TINY).rsqrt()
        for layer in self.layers:
            w = layer(w)
        return w


class Generator(nn.Module):
    """Mapping and synthesis. ``layers`` lists what each style steers."""

    def __init__(self, settings: GeneratorSettings):
        super().__init__()
        self.settings, self.layers = settings, style_layers(settings)
        channels, size = settings.channels, settings.style_size
        self.mapping = Mapping(settings)
        self.constant = nn.Parameter(torch.randn(1, channels(4), 4, 4))
        convs, colours = [StyledConv(channels(4), channels(4), size)], [channels(4)]
        for half, whole in pairwise(settings.resolutions):
            convs.append(StyledConv(channels(half), channels(whole), size, up=True))
            convs.append(StyledConv(channels(whole), channels(whole), size))
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
        """The maps stored with the weights."""
        return tuple(self.get_buffer(f"noise_{index}") for index in range(len(self.noise_sizes)))

    def random_noise(self, count: int, generator: RandomGenerator) -> tuple[Tensor, ...]:
        """Fresh maps for ``count`` images."""
        sizes = [(count, 1, side, side) for side in self.noise_sizes]
        return tuple(torch.randn(size, generator=generator).to(self.constant) for size in sizes)

    def random_w(self, count: int, generator: RandomGenerator) -> Float[Tensor, "n d"]:
        """w of standard normal z."""
        z = torch.randn(count, self.settings.style_size, generator=generator)
        return self.mapping(z.to(self.constant))

    @torch.no_grad()
    def mean_w(self, count: int, generator: RandomGenerator) -> Float[Tensor, " d"]:
        """The centre that truncation pulls to, from ``count`` latents."""
        return self.random_w(count, generator).mean(dim=0)

    def w_plus(self, w: Float[Tensor, "n d"] | Float[Tensor, "n codes d"]) -> Float[Tensor, "n codes d"]:
        """One w for all layers, or W+ as it is.

        Raises:
            ValueError: another number of codes, or of another length.
        """
        codes, size = self.settings.codes, self.settings.style_size
        expanded = w[:, None].expand(-1, codes, -1) if w.ndim == 2 else w
        if tuple(expanded.shape[1:]) != (codes, size):
            raise ValueError(
                f"this generator takes w of {size} numbers or W+ of {codes} x {size}, "
                f"got {tuple(w.shape[1:])}"
            )
        return expanded

    def styles(self, w_plus: Float[Tensor, "n codes d"]) -> list[Float[Tensor, "n _"]]:
        """Style space, one matrix for each steered layer."""
        return [self._module(layer).affine(w_plus[:, layer.code]) for layer in self.layers]

    def split_styles(self, flat: Float[Tensor, "n s"]) -> list[Float[Tensor, "n _"]]:
        """Style space cut into layers; ``torch.cat(styles, dim=1)`` is the way back."""
        return list(flat.split([layer.channels for layer in self.layers], dim=1))

    def synthesise(
        self, styles: Sequence[Float[Tensor, "n _"]], noise: Noise = None, *, watch: Watch | None = None
    ) -> Images:
        """An image, about -1..1, from one style for each layer."""
        maps, image = self.constant.expand(len(styles[0]), -1, -1, -1), None
        for number, (layer, style) in enumerate(zip(self.layers, styles, strict=True)):
            if watch is not None:
                watch(number, maps)
            module = self._module(layer)
            if layer.colour:
                image = module(maps, style, image)
            else:
                maps = module(maps, style, None if noise is None else noise[layer.index])
        assert image is not None
        return image

    def forward(self, w: Float[Tensor, "n d"] | Float[Tensor, "n codes d"], noise: Noise = None) -> Images:
        """An image, about -1..1, from w or W+."""
        return self.synthesise(self.styles(self.w_plus(w)), noise)

    def _module(self, layer: StyleLayer) -> StyledConv | ToRgb:
        return (self.to_rgbs if layer.colour else self.convs)[layer.index]  # pyright: ignore[reportReturnType]
