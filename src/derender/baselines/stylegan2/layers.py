"""Layers of StyleGAN2 in plain torch: equalised linear, resampling by a short filter, modulated convolution.

Source: Karras et al., *Analyzing and Improving the Image Quality of StyleGAN* (CVPR 2020), Sec. 2 and App. B;
equalised learning rates and the pixel norm are those of *Progressive Growing of GANs* (ICLR 2018). A style
scales the inputs of a convolution and its norm divides the outputs, which is the paper's modulated and
demodulated weight without one weight for each picture. Leaves out compiled kernels and half precision.
"""

from math import sqrt
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import conv2d, conv_transpose2d, leaky_relu, linear

FILTER = (0.125, 0.375, 0.375, 0.125)
"""Binomial taps that every change of resolution goes through; they add up to 1."""
TINY = 1e-8
SLOPE, GAIN = 0.2, sqrt(2)
"""Of the leaky ReLU, and what keeps its output's variance about 1."""


def upfirdn(
    images: Float[Tensor, "n c h w"],
    taps: Float[Tensor, " k"],
    *,
    up: int = 1,
    down: int = 1,
    padding: tuple[int, int] = (0, 0),
) -> Float[Tensor, "n c h2 w2"]:
    """Put ``up - 1`` zeros after each pixel, pad, convolve along both axes, keep every ``down``-th pixel.

    As scipy.signal.upfirdn along each axis; ``padding`` is counted after the zeros, before and behind, and
    cuts where it is negative. Zeros lie outside.
    """
    down_rows, along_rows = (_band(side, taps, up, down, padding) for side in images.shape[2:])
    return down_rows.T @ (images @ along_rows)


def _band(
    side: int, taps: Float[Tensor, " k"], up: int, down: int, padding: tuple[int, int]
) -> Float[Tensor, "side outputs"]:
    """The resampling of one axis as a matrix; on a CPU a product is faster than shifted sums."""
    outputs = (side * up + sum(padding) - len(taps)) // down + 1
    starts = down * torch.arange(outputs, device=taps.device) - padding[0]
    tap = len(taps) - 1 + starts - up * torch.arange(side, device=taps.device)[:, None]
    inside = (tap >= 0) & (tap < len(taps))
    return torch.where(inside, taps[tap.clamp(0, len(taps) - 1)], 0.0)


def upsample(images: Float[Tensor, "n c h w"], taps: Float[Tensor, " k"]) -> Float[Tensor, "n c h2 w2"]:
    """Twice the size; a constant stays what it is except at the border."""
    return upfirdn(images, 2 * taps, up=2, padding=(2, 1))


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
        found = linear(values, self.weight * self.scale, self.bias * self.rate)
        return leaky_relu(found, SLOPE) * GAIN if self.active else found


def pixel_norm(values: Float[Tensor, "n d"]) -> Float[Tensor, "n d"]:
    """Every row divided by its root mean square."""
    return values * (values.square().mean(dim=1, keepdim=True) + TINY).rsqrt()


def modulated_conv(
    images: Float[Tensor, "n i h w"],
    weight: Float[Tensor, "o i k k"],
    style: Float[Tensor, "n i"],
    *,
    demodulate: bool,
    taps: Float[Tensor, " t"] | None = None,
) -> Float[Tensor, "n o h2 w2"]:
    """Convolve with ``weight`` whose input channels are scaled by each picture's style.

    With ``demodulate`` every picture's kernel of an output channel has norm 1, so inputs of variance 1 give
    outputs of variance 1 and the style's length does not matter. With ``taps`` the picture becomes twice as
    large: a transposed convolution of stride 2, then the filter.
    """
    weight = weight / sqrt(weight[0].numel())
    found = images * style[:, :, None, None]
    if taps is None:
        found = conv2d(found, weight, padding=weight.shape[-1] // 2)
    else:
        found = conv_transpose2d(found, weight.transpose(0, 1), stride=2)
        found = upfirdn(found, 2 * taps, padding=(1, 1))
    if not demodulate:
        return found
    norm = style.square() @ weight.square().sum(dim=(2, 3)).T
    return found * (norm + TINY).rsqrt()[:, :, None, None]


class ModulatedConv(nn.Module):
    """A convolution and the affine map from w to its style; see ``modulated_conv``."""

    taps: Tensor

    def __init__(
        self,
        inputs: int,
        outputs: int,
        kernel: int,
        style_size: int,
        *,
        demodulate: bool = True,
        resample: Literal["none", "up"] = "none",
    ):
        super().__init__()
        self.weight = nn.Parameter(torch.randn(outputs, inputs, kernel, kernel))
        self.affine = EqualLinear(style_size, inputs, start=1.0)
        self.demodulate, self.up = demodulate, resample == "up"
        self.register_buffer("taps", torch.tensor(FILTER), persistent=False)

    def forward(self, images: Tensor, style: Tensor) -> Float[Tensor, "n o h w"]:
        return modulated_conv(
            images, self.weight, style, demodulate=self.demodulate, taps=self.taps if self.up else None
        )


class StyledConv(ModulatedConv):
    """Modulated 3x3 convolution, noise of a learnt strength, bias, leaky ReLU."""

    def __init__(self, inputs: int, outputs: int, style_size: int, *, resample: Literal["none", "up"]):
        super().__init__(inputs, outputs, 3, style_size, resample=resample)
        self.noise_strength = nn.Parameter(torch.zeros(1))
        self.bias = nn.Parameter(torch.zeros(outputs))

    def forward(
        self, images: Tensor, style: Tensor, noise: Float[Tensor, "m 1 h w"] | None = None
    ) -> Float[Tensor, "n o h w"]:
        found = super().forward(images, style)
        if noise is not None:
            found = found + self.noise_strength * noise
        return leaky_relu(found + self.bias[:, None, None], SLOPE) * GAIN


class ToRgb(ModulatedConv):
    """Modulated 1x1 convolution to three channels, not demodulated, added to the picture so far."""

    def __init__(self, inputs: int, style_size: int):
        super().__init__(inputs, 3, 1, style_size, demodulate=False)
        self.bias = nn.Parameter(torch.zeros(3))

    def forward(
        self, images: Tensor, style: Tensor, before: Float[Tensor, "n 3 h w"] | None = None
    ) -> Float[Tensor, "n 3 h2 w2"]:
        found = super().forward(images, style) + self.bias[:, None, None]
        return found if before is None else found + upsample(before, self.taps)


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

    def forward(self, images: Float[Tensor, "n i h w"]) -> Float[Tensor, "n o h2 w2"]:
        weight = self.weight / sqrt(self.weight[0].numel())
        kernel, bias = weight.shape[-1], self.bias
        if bias is not None:
            weight, bias = GAIN * weight, GAIN * bias  # as well as behind the activation, and cheaper
        if self.down:
            around = len(FILTER) - 2 + kernel - 1
            images = upfirdn(images, self.taps, padding=((around + 1) // 2, around // 2))
            found = conv2d(images, weight, bias, stride=2)
        else:
            found = conv2d(images, weight, bias, padding=kernel // 2)
        return found if bias is None else leaky_relu(found, SLOPE)
