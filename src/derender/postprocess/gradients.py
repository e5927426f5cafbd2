"""Directions of an image's gradients: slow changes of light turn them little.

Source: Gradientfaces (Zhang et al., TIP 2009), here as unit vectors, averaged over cells.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, conv2d, pad

from derender.scene.camera import constant

BLUR_PX = 0.75  # standard deviation of the Gaussian before differences are taken
CELLS = 32  # along each side
SCALE = 0.2  # near the variation of encoder activations; chosen on development halves
_DARK = 1 / 510  # half a grey level: shorter gradients are noise


def gradient_directions(images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n directions"]:
    """Unit vectors (right, down) of the gradient of the mean of colours, averaged over 32x32 cells.

    Images are in 0..1, at least 32 pixels wide and high. Values lie within -0.2..0.2.
    """
    taps = torch.exp(-torch.arange(-3.0, 4.0).square() / (2 * BLUR_PX**2))
    blur = constant(tuple((taps / taps.sum()).tolist()), images)
    grey = pad(images.mean(dim=1, keepdim=True), (4, 4, 4, 4), mode="replicate")
    smooth = conv2d(conv2d(grey, blur.view(1, 1, 1, -1)), blur.view(1, 1, -1, 1))
    right = smooth[..., 1:-1, 2:] - smooth[..., 1:-1, :-2]
    down = smooth[..., 2:, 1:-1] - smooth[..., :-2, 1:-1]
    slope = torch.cat([right, down], dim=1) / 2
    unit = slope / (slope.square().sum(dim=1, keepdim=True).add(1e-10).sqrt() + _DARK)
    return SCALE * adaptive_avg_pool2d(unit, CELLS).flatten(1)
