"""Whether a batch of pictures is what a model takes."""

import torch
from torch import Tensor


def check_pictures(images: Tensor, size: int) -> None:
    """Pictures of another shape than (N, 3, size, size), or of whole numbers, are an error."""
    if images.ndim != 4 or images.shape[1:] != (3, size, size):
        raise ValueError(
            f"this model takes pictures of shape (N, 3, {size}, {size}), got {tuple(images.shape)}: "
            f"read them with derender.data.read_pictures(..., image_size={size}) or resize them"
        )
    if not images.is_floating_point():
        raise ValueError(f"pictures must be floating point in 0..1, got {images.dtype}: divide uint8 by 255")


def refuse_not_finite(images: Tensor) -> None:
    """NaN or infinity in pictures is an error; not looked for on other devices, which would have to wait."""
    if images.device.type != "cpu" or torch.compiler.is_compiling() or bool(images.isfinite().all()):
        return
    first = int(images.isfinite().flatten(1).all(dim=1).int().argmin())
    raise ValueError(
        f"picture {first} of {len(images)} holds values that are not finite: give numbers in 0..1"
    )
