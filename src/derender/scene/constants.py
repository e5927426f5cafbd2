"""Small tensors of fixed numbers, made once for each device.

Making one anew brings it from the host, which waits for the device and cannot be part of a CUDA graph.
"""

from functools import lru_cache
from typing import Any

import torch
from torch import Tensor


def constant(values: Any, like: Tensor) -> Tensor:
    """Numbers in nested tuples as a tensor of another's dtype and on its device; never change it."""
    return kept(values, like.device, like.dtype)


@lru_cache(maxsize=256)
def kept(values: Any, device: torch.device, dtype: torch.dtype) -> Tensor:
    """The tensor of these numbers that every caller shares."""
    with torch.inference_mode(False):  # else it could serve no gradient later
        return torch.tensor(values, device=device, dtype=dtype)
