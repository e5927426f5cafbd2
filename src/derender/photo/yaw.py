"""How far a face is turned to the side: a small convolutional network that sees its crop in grey.

``benchmarks/yaw.py`` trained it on generated heads from -89 to 89 degrees, in the boxes of the detector.
Beside them it saw the development half of LFW, with the yaw of a face mesh. Leaves out heads that lie on
their side.
"""

from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from derender.storage.tensors import read_tensors

CROP, CROP_SIDE = 48, 1.4
"""Side of a crop in pixels, and in sides of the detector's box around the same centre."""
WIDTH = 12  # channels of the first layer
SCALE_DEG = 60.0
WEIGHTS = Path(__file__).with_name("yaw.safetensors")


def yaw_network() -> nn.Sequential:
    """Four halvings by convolution, then one linear layer; without trained weights."""
    widths = (1, WIDTH, 2 * WIDTH, 4 * WIDTH, 4 * WIDTH)
    layers: list[nn.Module] = []
    for before, after in pairwise(widths):
        layers += [nn.Conv2d(before, after, 4, 2, 1), nn.GroupNorm(4, after), nn.ReLU()]
    return nn.Sequential(*layers, nn.Flatten(), nn.Linear(widths[-1] * (CROP // 16) ** 2, 1))


def yaw_deg(crop: UInt8[np.ndarray, "3 h w"]) -> float:
    """Turn to the side of the face in a crop of ``CROP`` pixels, in degrees with the sign of our cameras."""
    with torch.inference_mode():
        seen = standardised(torch.from_numpy(crop)[None])
        left, right = _trained()(torch.cat([seen, seen.flip(-1)]))[:, 0].tolist()
    return SCALE_DEG * (left - right) / 2


def standardised(crops: UInt8[Tensor, "n 3 h w"]) -> Float[Tensor, "n 1 h w"]:
    """Grey values of mean 0 and about unit variance in each crop."""
    grey = crops.float().mean(dim=1, keepdim=True) / 255
    grey = grey - grey.mean(dim=(1, 2, 3), keepdim=True)
    return grey / (grey.std(dim=(1, 2, 3), keepdim=True) + 0.03)


@cache
def _trained() -> nn.Sequential:
    network = yaw_network()
    network.load_state_dict(read_tensors(WEIGHTS, like=network.state_dict()))
    return network
