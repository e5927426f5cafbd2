"""Code to map or to numbers.

Source: unsup3d's networks as pinned in the paper's appendix. No convolution has a bias; outputs are raw
(the factor's row in factors.py gives them range and meaning).
"""

from itertools import pairwise

from jaxtyping import Float
from torch import Tensor, nn

from derender.networks.convolutions import NarrowConv2d, UpsampledConv2d
from derender.networks.encoders import norm_relu, stage_widths
from derender.networks.settings import NetworkSettings


class MapDecoder(nn.Module):
    """A code becomes a picture-sized map with ``channels`` channels (depth: 1, albedo: 3), unbounded."""

    def __init__(self, settings: NetworkSettings, channels: int):
        super().__init__()
        widths = stage_widths(settings.width, settings.stages)[::-1]
        layers: list[nn.Module] = [
            nn.ConvTranspose2d(settings.code_size, widths[0], 4, bias=False),
            nn.ReLU(),
            nn.Conv2d(widths[0], widths[0], 3, padding=1, bias=False),
            nn.ReLU(),
        ]
        for previous, width in pairwise(widths):
            layers += [
                nn.ConvTranspose2d(previous, width, 4, stride=2, padding=1, bias=False),
                norm_relu(width),
                nn.Conv2d(width, width, 3, padding=1, bias=False),
                norm_relu(width),
            ]
        last = widths[-1]
        layers += [
            UpsampledConv2d(last, last),
            norm_relu(last),
            nn.Conv2d(last, last, 5, padding=2, bias=False),
            norm_relu(last),
        ]
        self.layers = nn.Sequential(*layers)
        self.last = NarrowConv2d(last, channels)

    def forward(self, code: Float[Tensor, "n code"]) -> Float[Tensor, "n channels h w"]:
        return self.last(self.layers(code[:, :, None, None]))


class VectorDecoder(nn.Module):
    """A code becomes a few numbers in -1..1 (light: 4, camera: 6); the tanh stands last and bounds them."""

    def __init__(self, code_size: int, numbers: int):
        super().__init__()
        self.linear = nn.Linear(code_size, numbers, bias=False)

    def forward(self, code: Float[Tensor, "n code"]) -> Float[Tensor, "n numbers"]:
        return self.linear(code).tanh()
