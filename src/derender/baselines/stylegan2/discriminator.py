"""StyleGAN2's discriminator: a residual net that scores how real pictures look.

Source: Karras et al. (CVPR 2020), with the standard deviation over groups of a batch as one more map
(Progressive Growing of GANs, ICLR 2018). Widths are the generator's. Leaves out class labels.
"""

from math import sqrt

import torch
from jaxtyping import Float
from torch import Tensor, nn

from derender.baselines.stylegan2.generator import GeneratorSettings
from derender.baselines.stylegan2.layers import TINY, EqualConv, EqualLinear

GROUP = 4


class Discriminator(nn.Module):
    """Picture in -1..1 to one number: high is real. ``describe`` gives what the last layer looks at."""

    def __init__(self, settings: GeneratorSettings):
        super().__init__()
        channels, sizes = settings.channels, settings.resolutions
        self.from_rgb = EqualConv(3, channels(sizes[-1]), 1)
        self.blocks = nn.Sequential(
            *(
                ResidualDown(channels(whole), channels(half))
                for whole, half in zip(sizes[:0:-1], sizes[-2::-1], strict=True)
            )
        )
        width = channels(4)
        self.last_conv = EqualConv(width + 1, width, 3)
        self.hidden = EqualLinear(16 * width, width, active=True)
        self.score = EqualLinear(width, 1)

    def describe(self, images: Float[Tensor, "n 3 h w"], *, group: int = 1) -> Float[Tensor, "n d"]:
        """The last hidden layer. With ``group`` 1 no picture sees another."""
        maps = with_group_deviation(self.blocks(self.from_rgb(images)), group)
        return self.hidden(self.last_conv(maps).flatten(1))

    def forward(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, " n"]:
        """Scores, log odds of being real; groups of up to four pictures are compared."""
        return self.score(self.describe(images, group=group_of(len(images))))[:, 0]


class ResidualDown(nn.Module):
    """Two convolutions and a skip to half the size; the sum is divided by sqrt 2."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.first = EqualConv(inputs, inputs, 3)
        self.second = EqualConv(inputs, outputs, 3, down=True)
        self.skip = EqualConv(inputs, outputs, 1, down=True, active=False)

    def forward(self, images: Float[Tensor, "n i h w"]) -> Float[Tensor, "n o h2 w2"]:
        return (self.second(self.first(images)) + self.skip(images)) / sqrt(2)


def group_of(count: int) -> int:
    """The largest group of at most four that divides a batch."""
    return next(size for size in range(GROUP, 0, -1) if count % size == 0)


def with_group_deviation(maps: Float[Tensor, "n c h w"], group: int) -> Float[Tensor, "n c1 h w"]:
    """The maps and one more: the mean standard deviation over each group of pictures.

    Picture i is in the group of pictures i modulo n / group.
    """
    n, _, height, width = maps.shape
    grouped = maps.reshape(group, n // group, -1)
    deviation = (grouped.var(dim=0, unbiased=False) + TINY).sqrt().mean(dim=1)
    extra = deviation.repeat(group)[:, None, None, None].expand(n, 1, height, width)
    return torch.cat([maps, extra], dim=1)
