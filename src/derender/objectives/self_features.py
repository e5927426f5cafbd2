"""A small convolutional net whose features were learned without labels from the training pictures themselves.

The stage layout is VGG16's up to relu3_3 (stride 1, 2, 4) at about a twenty-fifth of the multiplications,
with average instead of maximum pooling, so that the gradient reaches every pixel evenly. Source: the ablation
of unsup3d (Wu et al., CVPR 2020, table 2) finds self-supervised features as good as VGG's. How it learns:
self_training.py.
"""

import json
from pathlib import Path

import torch
from torch import nn

from derender.objectives.frozen import PerceptualFeatures
from derender.storage.tensors import read_described, write_tensors

DEFAULT_WIDTHS = (16, 32, 64)


class SelfFeatures(PerceptualFeatures):
    """Convolutions, ReLUs and average pooling: ``widths[-1]`` channels at a quarter of the resolution."""

    kind = "self"
    stride = 4

    def __init__(self, widths: tuple[int, int, int] = DEFAULT_WIDTHS):
        super().__init__(trunk(widths, normalised=False), (0.5, 0.5, 0.5), (0.25, 0.25, 0.25))
        self.widths = tuple(widths)
        self.channels = widths[-1]

    def save(self, path: Path | str) -> None:
        """Write weights, scale and widths to one safetensors file."""
        about = {"kind": self.kind, "widths": json.dumps(self.widths)}
        write_tensors(self.state_dict(), path, about)


def load_self_features(path: Path | str) -> SelfFeatures:
    """Read what ``SelfFeatures.save`` wrote."""
    try:
        tensors, metadata = read_described(path)
    except (ValueError, OSError) as problem:
        raise ValueError(f"the perceptual features in {path} cannot be read ({problem})") from problem
    if metadata.get("kind") != SelfFeatures.kind or "widths" not in metadata:
        raise ValueError(f"{path} holds no self-trained perceptual features; something else wrote it")
    try:
        net = SelfFeatures(tuple(json.loads(metadata["widths"])))
        net.load_state_dict(tensors)
    except (RuntimeError, ValueError, TypeError) as problem:
        raise ValueError(
            f"{path} does not fit its own widths; delete it, and they are learnt again"
        ) from problem
    return net


def trunk(widths: tuple[int, int, int], normalised: bool) -> nn.Sequential:
    """The layers of the net; ``normalised`` puts a BatchNorm after each convolution, for training."""
    if len(widths) != 3 or min(widths) < 1:
        raise ValueError(f"the self-trained features need three positive widths, got {widths}")
    full, half, quarter = widths
    layers: list[nn.Module] = []
    for channels_in, channels_out, pool in (
        (3, full, True),
        (full, half, False),
        (half, half, True),
        (half, quarter, False),
        (quarter, quarter, False),
    ):
        layers.append(nn.Conv2d(channels_in, channels_out, 3, padding=1, bias=not normalised))
        if normalised:
            layers.append(nn.BatchNorm2d(channels_out))
        layers.append(nn.ReLU(inplace=True))
        if pool:
            layers.append(nn.AvgPool2d(2))
    return nn.Sequential(*layers)


@torch.no_grad()
def without_normalisation(normalised: nn.Sequential, widths: tuple[int, int, int]) -> nn.Sequential:
    """What the trained layers compute in evaluation mode, every BatchNorm folded into its convolution."""
    folded = trunk(widths, normalised=False)
    plain = [layer for layer in folded if isinstance(layer, nn.Conv2d)]
    convolutions = [layer for layer in normalised if isinstance(layer, nn.Conv2d)]
    norms = [layer for layer in normalised if isinstance(layer, nn.BatchNorm2d)]
    for target, convolution, norm in zip(plain, convolutions, norms, strict=True):
        assert norm.running_var is not None and norm.running_mean is not None and target.bias is not None
        gain = norm.weight / (norm.running_var + norm.eps).sqrt()
        target.weight.copy_(convolution.weight * gain.view(-1, 1, 1, 1))
        target.bias.copy_(norm.bias - norm.running_mean * gain)
    return folded
