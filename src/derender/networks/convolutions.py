"""Two convolutions that do less work for the same result and the same weights.

Both rest on one fact: a convolution is linear in its kernel, so kernels can be combined or shifted before
they meet the picture. Results agree with the plain layers to rounding. Leaves out biases: no convolution
here has one.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional


class UpsampledConv2d(nn.Conv2d):
    """Nearest-neighbour doubling, then a 3x3 convolution, done as one transposed convolution.

    Of the 3x3 values under the kernel only 2x2 differ: 4 multiplications instead of 9.
    """

    def __init__(self, channels_in: int, channels_out: int):
        super().__init__(channels_in, channels_out, 3, padding=1, bias=False)

    def forward(self, input: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c2 h2 w2"]:
        doubling = self.weight.new_ones(1, 1, 2, 2)
        flipped = self.weight.flip(2, 3).flatten(0, 1)[:, None]
        kernel = functional.conv2d(flipped, doubling, padding=1)[:, 0].unflatten(0, self.weight.shape[:2])
        return functional.conv_transpose2d(input, kernel.transpose(0, 1), stride=2, padding=1)


class NarrowConv2d(nn.Conv2d):
    """A 5x5 convolution to very few channels, done for a block of neighbouring pixels at a time.

    Processors work on 16 channels or more at once, so one to three of them leave most lanes empty. The pixels
    of a block become channels: one convolution with the kernel shifted to each of them, then put in their
    places. Height and width must be multiples of the block (4 for one channel, else 2).
    """

    def __init__(self, channels_in: int, channels_out: int):
        super().__init__(channels_in, channels_out, 5, padding=2, bias=False)
        self.block = 4 if channels_out == 1 else 2

    def forward(self, input: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c2 h w"]:
        last = self.block - 1
        shifted = [
            functional.pad(self.weight, (across, last - across, down, last - down))
            for down in range(self.block)
            for across in range(self.block)
        ]
        kernel = torch.stack(shifted, dim=1).flatten(0, 1).contiguous(memory_format=torch.channels_last)
        blocks = functional.conv2d(input, kernel, stride=self.block, padding=2)
        return functional.pixel_shuffle(blocks, self.block)
