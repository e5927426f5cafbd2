"""StyleGAN2's generator in plain torch: z to w to styles to an image, to 1024 pixels.

Source: Karras et al., *Analyzing and Improving the Image Quality of StyleGAN* (CVPR 2020); equalised learning
rates and the pixel norm: *Progressive Growing of GANs* (ICLR 2018). Configuration F has min(512, 32768 /
resolution) channels. Images are about -1..1. Codes are w (one vector), W+ (one w for each depth, 18 at 1024
pixels), and style space: the output of the layers' affine maps on W+. Style space has one number for each
input channel of each layer, colour layers included (9,088 at 1024 pixels). A style scales the inputs of a
convolution and its norm divides the outputs: the paper's modulated and demodulated weight without one weight
per image.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import log2, sqrt
from typing import Annotated, Any

import torch
from jaxtyping import Float
from pydantic import AfterValidator, Field
from torch import Generator as RandomGenerator
from torch import Tensor, nn
from torch.nn.functional import conv2d, conv_transpose2d, leaky_relu, linear

from derender.baselines.model import BaselineSettings, Images

FILTER = (0.125, 0.375, 0.375, 0.125)  # binomial taps of every change of resolution; they add up to 1
TINY = 1e-8
SLOPE, GAIN = 0.2, sqrt(2)  # of the leaky ReLU, and the gain that keeps its output's variance about 1

Maps = Float[Tensor, "n _ _ _"]  # any number of channels and any size
Codes = Float[Tensor, "n codes d"]  # W+
Styles = Sequence[Float[Tensor, "n _"]]  # style space, one matrix for each steered layer
Noise = Sequence[Tensor] | None  # a (m, 1, r, r) map for every styled convolution, m = 1 or n; None: no noise


def _power_of_two(side: int) -> int:
    if not (8 <= side <= 1024 and side.bit_count() == 1):
        raise ValueError(f"images of 8, 16, 32, ... 1024 pixels are made, not {side}")
    return side


Side = Annotated[int, AfterValidator(_power_of_two)]  # of images, in pixels


class GeneratorSettings(BaselineSettings):
    """Sizes; the defaults are small. The published FFHQ network has 1024, 512, 8, 0.01, 32768 and 512."""

    image_size: Side = 64
    style_size: int = Field(default=128, ge=1)
    mapping_layers: int = Field(default=8, ge=1)
    mapping_rate: float = Field(default=0.01, gt=0)
    channel_base: int = Field(default=2048, ge=32)  # channels times resolution
    channel_max: int = Field(default=64, ge=1)

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


def upfirdn(images: Maps, taps: Float[Tensor, " k"], *, up: int = 1, padding: tuple[int, int]) -> Maps:
    """Put ``up - 1`` zeros after each pixel, pad, and convolve along both axes.

    As scipy.signal.upfirdn along each axis; ``padding`` is counted after the zeros, before and behind. Zeros
    lie outside. Each axis is resampled by a matrix: on a CPU a product is faster than shifted sums.
    """

    def band(side: int) -> Float[Tensor, "side outputs"]:
        starts = torch.arange(side * up + sum(padding) - len(taps) + 1, device=taps.device) - padding[0]
        tap = len(taps) - 1 + starts - up * torch.arange(side, device=taps.device)[:, None]
        return torch.where((tap >= 0) & (tap < len(taps)), taps[tap.clamp(0, len(taps) - 1)], 0.0)

    return band(images.shape[2]).T @ (images @ band(images.shape[3]))


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


class EqualConv(nn.Module):
    """A convolution with equalised learning rate; ``down`` halves the size behind the filter.

    ``active``: bias, leaky ReLU with its gain; otherwise neither.
    """

    taps: Tensor

    def __init__(self, inputs: int, outputs: int, kernel: int, *, down: bool = False, active: bool = True):
        super().__init__()
        self.weight = nn.Parameter(torch.randn(outputs, inputs, kernel, kernel))
        self.bias = nn.Parameter(torch.zeros(outputs)) if active else None
        self.down = down
        self.register_buffer("taps", torch.tensor(FILTER), persistent=False)

    def forward(self, images: Maps) -> Maps:
        weight, bias = self.weight / sqrt(self.weight[0].numel()), self.bias
        kernel = weight.shape[-1]
        stride, padding = (2, 0) if self.down else (1, kernel // 2)
        if bias is not None:
            weight, bias = GAIN * weight, GAIN * bias  # as well as behind the activation, and cheaper
        if self.down:
            around = len(FILTER) - 2 + kernel - 1
            images = upfirdn(images, self.taps, padding=((around + 1) // 2, around // 2))
        made = conv2d(images, weight, bias, stride, padding)
        return made if bias is None else leaky_relu(made, SLOPE)


class ModulatedConv(nn.Module):
    """A convolution whose input channels are scaled by each image's style, and the affine map to it from w.

    With ``demodulate`` every image's kernel of an output channel has norm 1. So inputs of variance 1 give
    outputs of variance 1, and the style's length does not matter. With ``up`` the image becomes twice as
    large: a transposed convolution of stride 2, then the filter.
    """

    taps: Tensor

    def __init__(
        self, inputs: int, outputs: int, kernel: int, style_size: int, *, demodulate: bool, up: bool = False
    ):
        super().__init__()
        self.weight = nn.Parameter(torch.randn(outputs, inputs, kernel, kernel))
        self.affine = EqualLinear(style_size, inputs, start=1.0)
        self.demodulate, self.up = demodulate, up
        self.register_buffer("taps", torch.tensor(FILTER), persistent=False)

    def forward(self, images: Maps, style: Float[Tensor, "n i"]) -> Maps:
        weight = self.weight / sqrt(self.weight[0].numel())
        made = images * style[:, :, None, None]
        if self.up:
            made = conv_transpose2d(made, weight.transpose(0, 1), stride=2)
            made = upfirdn(made, 2 * self.taps, padding=(1, 1))
        else:
            made = conv2d(made, weight, padding=weight.shape[-1] // 2)
        if not self.demodulate:
            return made
        norm = style.square() @ weight.square().sum(dim=(2, 3)).T
        return made * (norm + TINY).rsqrt()[:, :, None, None]


class StyledConv(ModulatedConv):
    """Modulated 3x3 convolution, noise of a learnt strength, bias, leaky ReLU; ``up`` doubles the size."""

    def __init__(self, inputs: int, outputs: int, style_size: int, *, up: bool = False):
        super().__init__(inputs, outputs, 3, style_size, demodulate=True, up=up)
        self.noise_strength = nn.Parameter(torch.zeros(1))
        self.bias = nn.Parameter(torch.zeros(outputs))

    def forward(self, images: Maps, style: Tensor, noise: Float[Tensor, "m 1 h w"] | None = None) -> Maps:
        made = super().forward(images, style)
        if noise is not None:
            made = made + self.noise_strength * noise
        return leaky_relu(made + self.bias[:, None, None], SLOPE) * GAIN


class ToRgb(ModulatedConv):
    """Modulated 1x1 convolution to three channels, not demodulated, added to the enlarged image so far."""

    def __init__(self, inputs: int, style_size: int):
        super().__init__(inputs, 3, 1, style_size, demodulate=False)
        self.bias = nn.Parameter(torch.zeros(3))

    def forward(self, images: Maps, style: Tensor, before: Maps | None = None) -> Maps:
        made = super().forward(images, style) + self.bias[:, None, None]
        return made if before is None else made + upfirdn(before, 2 * self.taps, up=2, padding=(2, 1))


@dataclass(frozen=True)
class StyleLayer:
    """One layer that a style steers."""

    colour: bool  # whether it makes colours (ToRGB) or is a styled convolution
    code: int  # the w of W+ that it takes: also which of the convolutions it is, and half of it which ToRGB
    resolution: int  # of the activation that the style scales, in pixels
    channels: int  # numbers in its style


def style_layers(settings: GeneratorSettings) -> tuple[StyleLayer, ...]:
    """Every steered layer in the order in which an image is made: style space's order."""
    rows = [(False, 0, 4), (True, 1, 4)]
    for step, (half, size) in enumerate(pairwise(settings.resolutions)):
        code = 2 * step + 1
        rows += [(False, code, half), (False, code + 1, size), (True, code + 2, size)]
    return tuple(StyleLayer(*row, settings.channels(row[-1])) for row in rows)


class Generator(nn.Module):
    """Mapping and synthesis. ``layers`` lists what each style steers."""

    def __init__(self, settings: GeneratorSettings):
        super().__init__()
        self.settings, self.layers = settings, style_layers(settings)
        channels, size, rate = settings.channels, settings.style_size, settings.mapping_rate
        steps = (EqualLinear(size, size, rate=rate, active=True) for _ in range(settings.mapping_layers))
        self.mapping = nn.ModuleDict({"layers": nn.Sequential(*steps)})  # the name in saved weights
        self.constant = nn.Parameter(torch.randn(1, channels(4), 4, 4))
        convs = [StyledConv(channels(4), channels(4), size)]
        for half, whole in pairwise(settings.resolutions):
            convs.append(StyledConv(channels(half), channels(whole), size, up=True))
            convs.append(StyledConv(channels(whole), channels(whole), size))
        self.convs = nn.ModuleList(convs)
        self.to_rgbs = nn.ModuleList(ToRgb(channels(side), size) for side in settings.resolutions)
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
        """w of standard normal z, each of which is divided by its root mean square."""
        z = torch.randn(count, self.settings.style_size, generator=generator).to(self.constant)
        return self.mapping["layers"](z * (z.square().mean(dim=1, keepdim=True) + TINY).rsqrt())

    def w_plus(self, w: Float[Tensor, "n d"] | Codes) -> Codes:
        """One w for all layers, or W+ as it is."""
        return w[:, None].expand(-1, self.settings.codes, -1) if w.ndim == 2 else w

    def styles(self, w_plus: Codes) -> Styles:
        """Style space of W+."""
        return [self._module(layer).affine(w_plus[:, layer.code]) for layer in self.layers]

    def synthesise(self, styles: Styles, noise: Noise = None, seen: list[Tensor] | None = None) -> Images:
        """An image, about -1..1, from one style for each layer; ``seen`` collects what each scales."""
        maps, image = self.constant.expand(len(styles[0]), -1, -1, -1), None
        for layer, style in zip(self.layers, styles, strict=True):
            if seen is not None:
                seen.append(maps)
            module = self._module(layer)
            if layer.colour:
                image = module(maps, style, image)
            else:
                maps = module(maps, style, None if noise is None else noise[layer.code])
        assert image is not None
        return image

    def forward(self, w: Float[Tensor, "n d"] | Codes, noise: Noise = None) -> Images:
        """An image, about -1..1, from w or W+."""
        return self.synthesise(self.styles(self.w_plus(w)), noise)

    def _module(self, layer: StyleLayer) -> Any:
        return self.to_rgbs[layer.code // 2] if layer.colour else self.convs[layer.code]
