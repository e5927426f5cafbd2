"""VGG16 up to relu3_3, as perceptual features, from weights that the user already has.

Source: Simonyan & Zisserman 2015 (configuration D); layer choice of unsup3d (Wu et al., CVPR 2020). Layer
numbers and key names (``features.0.weight`` ...) are torchvision's. Leaves out everything after relu3_3, and
never downloads.
"""

import pickle
import zipfile
import zlib
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import nn

from derender.objectives.frozen import PerceptualFeatures
from derender.storage.tensors import refuse_old_torch

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
WHERE_TO_GET_IT = (
    "save https://download.pytorch.org/models/vgg16-397923af.pth (torchvision's ImageNet weights, 528 MB) "
    "in torch hub's cache, or anywhere and give its path"
)
# what the readers raise on bytes that are not theirs, the last three from torch.load's restricted unpickler
_DAMAGED = (
    zipfile.BadZipFile,
    zlib.error,
    SafetensorError,
    pickle.UnpicklingError,
    RuntimeError,
    EOFError,
    OSError,
    ValueError,
    LookupError,
    AttributeError,
    TypeError,
)
_WIDTHS = (64, 64, "pool", 128, 128, "pool", 256, 256, 256)


class Vgg16Features(PerceptualFeatures):
    """relu3_3 of VGG16: 256 channels at a quarter of the resolution."""

    kind = "vgg16"
    stride = 4
    channels = 256

    def __init__(self):
        layers: list[nn.Module] = []
        channels = 3
        for width in _WIDTHS:
            if isinstance(width, str):
                layers.append(nn.MaxPool2d(2))
            else:
                layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU(inplace=True)]
                channels = width
        super().__init__(nn.Sequential(*layers), IMAGENET_MEAN, IMAGENET_STD)


def load_vgg16(path: Path | str | None = None) -> Vgg16Features:
    """VGG16's first seven convolutions from .npz, .safetensors or .pth; None looks in torch hub's cache.

    Keys beyond relu3_3 are ignored. A ``.pth`` is read with ``weights_only=True``, so it cannot run code.
    """
    path = _cached_weights() if path is None else Path(path).expanduser()
    if not path.is_file():
        raise ValueError(f"no VGG16 weights at {path}: {WHERE_TO_GET_IT}")
    found = _read_weights(path)
    if not isinstance(found, dict):
        raise ValueError(
            f"{path} holds no named weights, so it is not torchvision's VGG16: {WHERE_TO_GET_IT}"
        )
    net = Vgg16Features()
    wanted = {name: value for name, value in net.state_dict().items() if name.startswith("features.")}
    for name, value in wanted.items():
        if name not in found:
            raise ValueError(f"{path} has no {name!r}, so it is not torchvision's VGG16: {WHERE_TO_GET_IT}")
        if found[name].shape != value.shape:
            raise ValueError(
                f"{name} in {path} has shape {tuple(found[name].shape)}, VGG16 needs {tuple(value.shape)}: "
                f"{WHERE_TO_GET_IT}"
            )
    net.load_state_dict({**net.state_dict(), **{name: found[name].float() for name in wanted}})
    return net


def _cached_weights() -> Path:
    folder = Path(torch.hub.get_dir()) / "checkpoints"
    candidates = sorted(folder.glob("vgg16-*.pth"))
    if not candidates:
        raise ValueError(f"no vgg16-*.pth in torch hub's cache {folder}: {WHERE_TO_GET_IT}")
    return candidates[0]


def _read_weights(path: Path) -> object:
    try:
        match path.suffix.lower():
            case ".npz":
                with np.load(path, allow_pickle=False) as archive:
                    return {name: torch.from_numpy(archive[name]) for name in archive.files}
            case ".safetensors":
                return load_file(path)
            case ".pth" | ".pt":
                refuse_old_torch(path)
                return torch.load(path, map_location="cpu", weights_only=True)
    except _DAMAGED as problem:
        raise ValueError(f"VGG16 weights in {path} cannot be read ({problem})") from problem
    raise ValueError(f"VGG16 weights in {path}: expected a .npz, .safetensors or .pth file")
