"""The labels of a batch, found by its pixels.

The training loop hands pictures to a step, in an order of its own and some of them mirrored, and knows no
labels. So every picture gets a key that is the same for its mirror image, and labels are kept by key.
Pictures that are each other's mirror image, or alike, and disagree on a label count as unknown.
"""

import numpy as np
import torch
from jaxtyping import Float, Int64, UInt8
from torch import Generator, Tensor

_CHUNK = 256
_MIX = 0x2545F4914F6CDD1D


class PixelLabels:
    """Targets of known pictures, on the device where batches are."""

    def __init__(self, images: UInt8[np.ndarray, "n 3 h w"], targets: np.ndarray, device: torch.device):
        """``targets``: (N, A) in -1 (unknown), 0, 1."""
        generator = Generator().manual_seed(0)
        size = images.shape[2] * images.shape[3] * 3
        self.weights = torch.randint(-(2**62), 2**62, (size,), generator=generator).to(device)
        parts = [
            self.keys(torch.from_numpy(np.array(images[start : start + _CHUNK])).to(device))
            for start in range(0, len(images), _CHUNK)
        ]
        keys, group = np.unique(torch.cat(parts).cpu().numpy(), return_inverse=True)
        low = np.full((len(keys), targets.shape[1]), 127, np.int8)
        high = np.full_like(low, -128)
        np.minimum.at(low, group, targets.astype(np.int8))
        np.maximum.at(high, group, targets.astype(np.int8))
        self.known = torch.from_numpy(keys).to(device)
        self.targets = torch.from_numpy(np.where(low == high, low, -1)).float().to(device)

    def keys(self, images: UInt8[Tensor, "b 3 h w"]) -> Int64[Tensor, " b"]:
        """One number for each picture, the same for its mirror image; integers wrap around."""
        return sum(self._mixed(view.flatten(1)) for view in (images, images.flip(-1)))  # type: ignore[return-value]

    def of(self, images: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b a"]:
        """The targets of pictures in 0..1 that are among those known, mirrored or not."""
        keys = self.keys((images * 255).round().to(torch.uint8))
        rows = torch.searchsorted(self.known, keys).clamp(max=len(self.known) - 1)
        assert bool((self.known[rows] == keys).all()), "a batch holds only pictures of the run"
        return self.targets[rows]

    def _mixed(self, pixels: UInt8[Tensor, "b d"]) -> Int64[Tensor, " b"]:
        key = (pixels.long() * self.weights).sum(dim=1)
        key = (key ^ (key >> 31)) * _MIX
        return key ^ (key >> 29)
