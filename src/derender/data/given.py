"""Images as a caller has them: a path, a Pillow image, a NumPy array, a tensor, or several of these.

Arrays of bytes, or of numbers in 0..1, may be (H, W, 3), (3, H, W) or grey (H, W). Batches are (N, H, W, 3)
or (N, 3, H, W). Leaves out data sets (opening).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from derender.data.image import PIXEL_LIMIT, Unreadable, decode_whole, fit_square, quiet_pillow, upright_rgb
from derender.data.image_set import check_images
from derender.data.source import FILE_LIMIT_BYTES
from derender.storage.bounded import read_bounded
from derender.storage.places import nearest_sibling

GivenImages: TypeAlias = str | Path | Image.Image | np.ndarray | Tensor | Sequence[Any]


def as_batch(
    images: GivenImages, size: int, device: torch.device | str = "cpu"
) -> Float[Tensor, "n 3 size size"]:
    """Images for a model of side ``size``, in 0..1.

    A tensor (N, 3, S, S) of numbers is returned as it is, on its own device. Files, Pillow images and arrays
    are cropped to their centre square and resized (Lanczos) where they have another size.

    Raises:
        ValueError: values outside 0..1, or an array that is no image; the message says how to convert it.
        FileNotFoundError: there is no such file.
    """
    if (
        isinstance(images, Tensor)
        and images.ndim == 4
        and images.is_floating_point()
        and images.shape[-1] != 3
    ):
        check_images(images, size)
        refuse_values(images)
        return images if images.dtype in (torch.float32, torch.bfloat16, torch.float16) else images.float()
    squares = [fit_square(Image.fromarray(photo), size, "crop") for photo in as_photos(images)]
    stacked = np.stack([np.asarray(square) for square in squares])
    return torch.from_numpy(stacked).permute(0, 3, 1, 2).to(device).float() / 255


def as_photos(images: GivenImages) -> list[UInt8[np.ndarray, "h w 3"]]:
    """Every image at its own size, as bytes; errors as `as_batch` raises them."""
    if isinstance(images, (str, Path)):
        return [read_photo(images)]
    if isinstance(images, Image.Image):
        return [np.array(upright_rgb(images))]
    if isinstance(images, Tensor):
        images = images.detach().cpu().numpy()
    if not isinstance(images, np.ndarray):
        if not isinstance(images, Sequence) or not images:
            raise TypeError(
                f"expected a path, a Pillow image, an array, a tensor or a list of them, got {images!r:.80}"
            )
        return [photo for image in images for photo in as_photos(image)]
    return [_as_bytes(image) for image in (_batch_of(images))]


def read_photo(path: str | Path, pixel_limit: int = PIXEL_LIMIT) -> UInt8[np.ndarray, "h w 3"]:
    """One image file at its own size, upright, as RGB; ``Unreadable`` says what is wrong with it."""
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist{nearest_sibling(path)}")
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder: name images, such as {path / '*.jpg'}")
    try:
        with quiet_pillow():
            return decode_whole(read_bounded(path, FILE_LIMIT_BYTES), pixel_limit)
    except ValueError as problem:
        raise Unreadable(f"{path} cannot be used as an image: {problem}") from problem


def refuse_values(images: Tensor | np.ndarray) -> None:
    """Numbers that are not finite or not in 0..1 are an error; not looked for on devices that would wait."""
    if isinstance(images, Tensor):
        if images.device.type != "cpu" or torch.compiler.is_compiling():
            return
        images = images.detach().numpy()
    if images.size == 0:
        return
    low, high = float(images.min()), float(images.max())
    if not np.isfinite([low, high]).all():
        first = int(np.isfinite(images.reshape(len(images), -1)).all(axis=1).argmin())
        raise ValueError(
            f"image {first} of {len(images)} holds values that are not finite: give numbers in 0..1"
        )
    if low < -1e-3 or high > 1 + 1e-3:
        fix = "divide by 255" if high > 2 else "add 1 and halve" if low >= -1.001 else "rescale them"
        raise ValueError(f"images hold values from {low:.3g} to {high:.3g}, not in 0..1: {fix}")


def _batch_of(array: np.ndarray) -> np.ndarray:
    """(N, H, W, 3) from any of the layouts."""
    shape = array.shape
    if array.ndim == 2:
        array = np.repeat(array[..., None], 3, axis=-1)
    if array.ndim == 3:
        array = array[None]
    if array.ndim == 4 and array.shape[-1] == 3:
        return array
    if array.ndim == 4 and array.shape[1] == 3:
        return array.transpose(0, 2, 3, 1)
    raise ValueError(
        f"an array of shape {shape} is no image: give (H, W, 3), (3, H, W), or a batch of either"
    )


def _as_bytes(image: np.ndarray) -> UInt8[np.ndarray, "h w 3"]:
    if image.dtype == np.uint8:
        return np.ascontiguousarray(image)
    if image.dtype.kind != "f":
        raise ValueError(f"images must be bytes (uint8) or numbers in 0..1, got {image.dtype}: convert them")
    refuse_values(image[None])
    return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)
