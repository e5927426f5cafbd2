"""The perceptual loss, and the frozen features that it compares: what all share, and VGG16 up to relu3_3.

Source of the loss: unsup3d (Wu et al., CVPR 2020), Eq. 7: a Gaussian of the feature difference, with a
confidence per feature location. Features are divided by one number measured on a calibration batch, so that
confidence terms mean the same whichever weights are used. Source of VGG16: Simonyan & Zisserman 2015
(configuration D), weights from disk. Leaves out self-supervised features (self_features.py) and downloading.
"""

from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from derender.objectives.reconstruction import Mask, at_least_float32, bounded_sigma, masked_mean
from derender.storage.tensors import check_fit, check_pickle, read_tensors, require_plain

CALIBRATION_IMAGES = 256
WEIGHTS = "https://download.pytorch.org/models/vgg16-397923af.pth (torchvision's ImageNet weights, 528 MB)"
WHERE_TO_GET_IT = f"save {WEIGHTS} in torch hub's cache, or anywhere and give its path"


def perceptual_loss(
    prediction: Float[Tensor, "n c fh fw"], target: Float[Tensor, "n c fh fw"], mask: Mask,
    sigma: Float[Tensor, "n 1 sh sw"] | None,
) -> Float[Tensor, ""]:  # fmt: skip
    """``|df|^2 / (2 sigma^2) + log sigma`` with |df|^2 averaged over channels, weighted by the mask's share.

    The mask is average-pooled to the features' resolution. Without sigma it is the plain mean of |df|^2 (not
    half of it), as in unsup3d's code; 0 is best there. Best sigma is |df|.
    """
    height, width = size = prediction.shape[-2], prediction.shape[-1]
    pooled = functional.adaptive_avg_pool2d(mask if mask.is_floating_point() else mask.float(), size)
    weight = at_least_float32(pooled)
    kept = (weight > 0).unsqueeze(1)
    difference = at_least_float32(prediction) - at_least_float32(target)
    squared = torch.where(kept, difference, 0.0).square().mean(dim=1)
    if sigma is None:
        return masked_mean(squared, weight)
    if sigma.shape[-2:] != size:
        got = f"got shape {tuple(sigma.shape)}; let the confidence net put out that size"
        raise ValueError(f"the perceptual sigma must have the features' resolution {height} x {width}, {got}")
    deviation = bounded_sigma(torch.where(kept, sigma, 1.0))[:, 0]
    return masked_mean(squared / (2 * deviation.square()) + deviation.log(), weight)


class PerceptualFeatures(nn.Module):
    """A frozen net from images in 0..1 to feature maps; always in evaluation mode, never trained further."""

    stride: int  # pixels per feature location
    channels: int
    scale: Tensor
    image_mean: Tensor
    image_std: Tensor

    def __init__(self, features: nn.Sequential, image_mean: tuple[float, ...], image_std: tuple[float, ...]):
        super().__init__()
        self.features = features
        self.register_buffer("scale", torch.ones(()))
        self.register_buffer("image_mean", torch.tensor(image_mean).view(1, 3, 1, 1))
        self.register_buffer("image_std", torch.tensor(image_std).view(1, 3, 1, 1))
        self.requires_grad_(False)
        self.eval()

    def forward(self, images: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n c fh fw"]:
        """Calibrated features, with gradient to the images (never to the weights)."""
        return self.features((images - self.image_mean) / self.image_std) * self.scale

    @torch.no_grad()
    def calibrate_(self, images: Float[Tensor, "n 3 h w"]) -> "PerceptualFeatures":
        """Make the standard deviation of features about their channel means 1 on these few hundred images.

        It is pooled over channels (one number for all), so relations between channels stay.
        """
        self.scale.fill_(1.0)
        count = 0
        total = square = torch.zeros(self.channels, dtype=torch.float64, device=images.device)
        for batch in images.split(16):
            features = self(batch).double()
            count += features.numel() // self.channels
            total = total + features.sum(dim=(0, 2, 3))
            square = square + features.square().sum(dim=(0, 2, 3))
        deviation = (square / count - (total / count).square()).clamp(min=0).mean().sqrt().item()
        if not 1e-8 < deviation < float("inf"):
            over = f"{len(images)} calibration images (standard deviation {deviation:g})"
            fix = "give images that differ, or check the weights"
            raise ValueError(f"the perceptual features do not vary over {over}; {fix}")
        self.scale.fill_(1.0 / deviation)
        return self

    def train(self, mode: bool = True) -> "PerceptualFeatures":
        """Stay in evaluation mode, whatever the model around it does."""
        return super().train(False)


class Vgg16Features(PerceptualFeatures):
    """relu3_3 of VGG16: 256 channels at a quarter of the resolution."""

    stride, channels = 4, 256

    def __init__(self):
        layers: list[nn.Module] = []
        for place, pair in enumerate(pairwise((3, 64, 64, 128, 128, 256, 256, 256))):
            layers += [nn.Conv2d(*pair, 3, padding=1), nn.ReLU(inplace=True)]
            layers += [nn.MaxPool2d(2)] if place in (1, 3) else []
        super().__init__(nn.Sequential(*layers), (0.485, 0.456, 0.406), (0.229, 0.224, 0.225))  # ImageNet's


def load_vgg16(path: Path | str | None = None) -> Vgg16Features:
    """VGG16's first seven convolutions from .npz, .safetensors or .pth; None looks in torch hub's cache.

    Keys beyond relu3_3 are ignored. A ``.pth`` is read with ``weights_only=True``, so it cannot run code.
    """
    if path is None:
        folder = Path(torch.hub.get_dir()) / "checkpoints"
        cached = sorted(folder.glob("vgg16-*.pth"))
        if not cached:
            raise ValueError(f"no vgg16-*.pth in torch hub's cache {folder}: {WHERE_TO_GET_IT}")
        path = cached[0]
    path = Path(path).expanduser()
    if not path.is_file():
        raise ValueError(f"no VGG16 weights at {path}: {WHERE_TO_GET_IT}")
    result = _read_weights(path)
    net = Vgg16Features()
    expected = net.features.state_dict(prefix="features.")
    try:
        if not isinstance(result, dict):
            raise ValueError("it holds no named weights")
        named = {name: value for name, value in result.items() if name in expected}
        check_fit(named, expected)
    except ValueError as problem:
        raise ValueError(f"{path} is not torchvision's VGG16 ({problem}): {WHERE_TO_GET_IT}") from problem
    net.load_state_dict({**net.state_dict(), **{name: value.float() for name, value in named.items()}})
    return net


def _read_weights(path: Path) -> object:
    try:
        match path.suffix.lower():
            case ".npz":
                with np.load(path, allow_pickle=False) as archive:
                    return {name: torch.from_numpy(archive[name]) for name in archive.files}
            case ".safetensors":
                return read_tensors(path)
            case ".pth" | ".pt":
                check_pickle(path)
                weights = torch.load(path, map_location="cpu", weights_only=True)
                require_plain(weights if isinstance(weights, dict) else {}, path)
                return weights
    except Exception as problem:  # on bytes that are not theirs readers raise errors of any kind
        raise ValueError(f"VGG16 weights in {path} cannot be read ({problem})") from problem
    raise ValueError(f"VGG16 weights in {path}: expected a .npz, .safetensors or .pth file")
