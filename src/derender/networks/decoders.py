"""Code to map or to numbers, and image to the per-pixel uncertainty of its reconstruction.

Source: unsup3d's networks as pinned in the paper's appendix. No convolution has a bias; outputs are raw.
`UpsampledConv2d` and `NarrowConv2d` do less work than the plain layers for the same result, to rounding: a
convolution is linear in its kernel, so kernels can be combined or shifted before they meet the image.
"""

from dataclasses import dataclass
from itertools import pairwise, product

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.functional import softplus

from derender.networks.encoders import Encoder, NetworkSettings, NormReLU, stage_widths
from derender.scene.enlarge import doubled


class MapDecoder(nn.Module):
    """A code becomes an image-sized map with ``channels`` channels (depth: 1, albedo: 3), unbounded."""

    def __init__(self, settings: NetworkSettings, channels: int):
        super().__init__()
        widths = stage_widths(settings.width, settings.stages)[::-1]
        layers: list[nn.Module] = [nn.ConvTranspose2d(settings.code_size, widths[0], 4, bias=False)]
        layers += [nn.ReLU(), nn.Conv2d(widths[0], widths[0], 3, padding=1, bias=False), nn.ReLU()]
        for previous, width in pairwise(widths):
            layers += doubling(previous, width)
            layers += [nn.Conv2d(width, width, 3, padding=1, bias=False), NormReLU(width)]
        last = widths[-1]
        layers += [UpsampledConv2d(last, last), NormReLU(last)]
        layers += [nn.Conv2d(last, last, 5, padding=2, bias=False), NormReLU(last)]
        self.layers = nn.Sequential(*layers)
        self.last = NarrowConv2d(last, channels)
        self.growth = nn.ModuleList(Growth(last, channels) for _ in range(settings.doublings))

    def forward(self, code: Float[Tensor, "n code"]) -> Float[Tensor, "n channels h w"]:
        features = self.layers(code[:, :, None, None])
        maps = self.last(features)
        for growth in self.growth:
            features, maps = growth(features, maps)
        return maps


class Growth(nn.Module):
    """A map at twice its size, and what further features add to it: nothing before they are trained.

    Source: progressive growing (Karras et al., ICLR 2018), as a residual instead of a fade.
    """

    def __init__(self, width: int, channels: int):
        super().__init__()
        self.layers = nn.Sequential(UpsampledConv2d(width, width), NormReLU(width))
        self.last = NarrowConv2d(width, channels)
        nn.init.zeros_(self.last.weight)

    def forward(
        self, features: Float[Tensor, "n width h w"], maps: Float[Tensor, "n channels h w"]
    ) -> tuple[Float[Tensor, "n width h2 w2"], Float[Tensor, "n channels h2 w2"]]:
        features = self.layers(features)
        return features, doubled(maps, "smooth" if maps.shape[1] == 1 else "sharp") + self.last(features)


class VectorDecoder(nn.Module):
    """A code becomes a few numbers in -1..1 (light: 4, camera: 6); the tanh stands last and bounds them."""

    def __init__(self, code_size: int, numbers: int):
        super().__init__()
        self.linear = nn.Linear(code_size, numbers, bias=False)

    def forward(self, code: Float[Tensor, "n code"]) -> Float[Tensor, "n numbers"]:
        return self.linear(code).tanh()


def doubling(channels_in: int, channels_out: int) -> list[nn.Module]:
    """A transposed convolution to twice the size, normalised and rectified."""
    upsample = nn.ConvTranspose2d(channels_in, channels_out, 4, stride=2, padding=1, bias=False)
    return [upsample, NormReLU(channels_out)]


class UpsampledConv2d(nn.Conv2d):
    """Nearest-neighbour doubling and a 3x3 convolution as one transposed convolution: 4 products, not 9."""

    def __init__(self, channels_in: int, channels_out: int):
        super().__init__(channels_in, channels_out, 3, padding=1, bias=False)

    def forward(self, input: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c2 h2 w2"]:
        square = self.weight.new_ones(1, 1, 2, 2)
        flipped = self.weight.flip(2, 3).flatten(0, 1)[:, None]
        kernel = functional.conv2d(flipped, square, padding=1)[:, 0].unflatten(0, self.weight.shape[:2])
        return functional.conv_transpose2d(input, kernel.transpose(0, 1), stride=2, padding=1)


class NarrowConv2d(nn.Conv2d):
    """A 5x5 convolution to very few channels, done for a block of neighbouring pixels at a time.

    The pixels of a block become channels, of which processors work on many at once. Height and width are
    multiples of the block (4 for one channel, else 2).
    """

    def __init__(self, channels_in: int, channels_out: int):
        super().__init__(channels_in, channels_out, 5, padding=2, bias=False)
        self.block = 4 if channels_out == 1 else 2

    def forward(self, input: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c2 h w"]:
        last, places = self.block - 1, product(range(self.block), repeat=2)
        shifted = [functional.pad(self.weight, (x, last - x, y, last - y)) for y, x in places]
        kernel = torch.stack(shifted, dim=1).flatten(0, 1).contiguous(memory_format=torch.channels_last)
        blocks = functional.conv2d(input, kernel, stride=self.block, padding=2)
        return functional.pixel_shuffle(blocks, self.block)


@dataclass(frozen=True)
class Confidence:
    """Standard deviations, positive, of the reconstruction and of its flipped twin."""

    photometric: Float[Tensor, "n 1 h w"]  # of colours
    photometric_flip: Float[Tensor, "n 1 h w"]
    perceptual: Float[Tensor, "n 1 h4 w4"]  # of perceptual features, at a quarter of the resolution
    perceptual_flip: Float[Tensor, "n 1 h4 w4"]


class ConfidenceNet(nn.Module):
    """Image to four maps of uncertainty."""

    def __init__(self, settings: NetworkSettings):
        super().__init__()
        width, code = settings.width, settings.confidence_code_size
        self.encoder = Encoder(settings, width, code, normalised=True)
        previous = 8 * width
        upsampling: list[nn.Module] = [nn.ConvTranspose2d(code, previous, 4, bias=False), nn.ReLU()]
        for stage in range(settings.stages - 2):
            before, previous = previous, max(4 * width // 2**stage, 2 * width)
            upsampling += doubling(before, previous)
        self.trunk = nn.Sequential(*upsampling)
        twice = doubling(previous, width) + doubling(width, width)
        self.photometric_head = nn.Sequential(*twice, NarrowConv2d(width, 2))
        self.perceptual_head = nn.Conv2d(previous, 2, 3, padding=1, bias=False)
        self.doublings = settings.doublings

    def forward(self, images: Float[Tensor, "n 3 h w"]) -> Confidence:
        trunk = self.trunk(self.encoder(images)[:, :, None, None])
        maps = [self.photometric_head(trunk).float(), self.perceptual_head(trunk).float()]
        for _ in range(self.doublings):
            maps = [doubled(one, "smooth") for one in maps]
        photometric, perceptual = map(softplus, maps)
        return Confidence(photometric[:, :1], photometric[:, 1:], perceptual[:, :1], perceptual[:, 1:])
