"""From values to colours: images, depth maps, normals and shading as 8-bit images.

Every function takes one array for a whole set and uses one range for all of it: images side by side can be
compared. Leaves out layout (see ``panel``) and anything that needs a model.
"""

from io import BytesIO
from typing import Any

import cv2
import numpy as np
from PIL import Image
from torch import Tensor

Images = list[Image.Image]
Values = Tensor | np.ndarray


def as_numpy(values: Values) -> np.ndarray:
    """The same values as a numpy array, wherever the tensor lives."""
    return values.detach().cpu().float().numpy() if isinstance(values, Tensor) else np.asarray(values)


def pictures(values: Values, mask: Values | None = None) -> Images:
    """(N, 3, H, W) colours, uint8 or float 0..1, as images; pixels outside ``mask`` are transparent."""
    colours = as_numpy(values)
    if colours.ndim != 4 or colours.shape[1] != 3:
        raise ValueError(f"images must have shape (N, 3, H, W); got {colours.shape}")
    return _images(np.moveaxis(colours, 1, -1), mask)


def depth_range(depth: Values, mask: Values | None = None) -> tuple[float, float]:
    """Nearest and farthest depth worth showing: 1st and 99th percentile of all covered pixels."""
    values = as_numpy(depth)
    covered = values[np.isfinite(values) & (True if mask is None else as_numpy(mask) > 0.5)]
    near, far = np.percentile(covered, (1, 99)) if covered.size else (0.0, 1.0)
    return float(near), float(far)


def depth_maps(
    depth: Values, mask: Values | None = None, limits: tuple[float, float] | None = None
) -> Images:
    """(N, H, W) depth as images, near is bright; one range for the whole set."""
    near, far = limits or depth_range(depth, mask)
    values = np.nan_to_num(as_numpy(depth), nan=far)
    nearness = np.clip((far - values) / max(far - near, 1e-9), 0, 1)
    magma = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_MAGMA)[:, 0, ::-1]
    return _images(magma[np.minimum(256 * nearness, 255).astype(np.uint8)], mask)


def normal_maps(normal: Values, mask: Values | None = None) -> Images:
    """(N, H, W, 3) inward unit normals (y down) in the colours of a tangent-space normal map.

    Red grows to the right, green upwards, blue towards the viewer, all of the OUTWARD normal.
    """
    outward_right_up_viewer = as_numpy(normal) * np.array([-1.0, 1.0, 1.0])
    return _images((outward_right_up_viewer + 1) / 2, mask)


def shading_maps(shading: Values) -> Images:
    """(N, 1 or 3, H, W) shading as images; white is 1, or the 99th percentile where that is more."""
    light = np.moveaxis(as_numpy(shading), 1, -1)
    white = max(1.0, float(np.percentile(light, 99))) if light.size else 1.0
    return _images(np.broadcast_to(light / white, (*light.shape[:3], 3)), None)


def level_maps(values: Values) -> Images:
    """(N, H, W) levels or (N, 3, H, W) colours in 0..1 as images."""
    levels = as_numpy(values)
    return pictures(np.stack([levels] * 3, axis=1) if levels.ndim == 3 else levels)


def any_maps(values: Values) -> Images:
    """The parameter of any further factor as images: (N, 3, H, W) colours or (N, H, W) levels; else none."""
    maps = as_numpy(values)
    if maps.ndim == 3:
        return depth_maps(-maps)
    return pictures(maps) if maps.ndim == 4 and maps.shape[1] == 3 else []


def _images(colours: np.ndarray, mask: Values | None) -> Images:
    """(N, H, W, 3) floats 0..1 or uint8, and a mask (N, H, W) or None, as RGB or RGBA images."""
    pixels = colours if colours.dtype == np.uint8 else np.rint(np.clip(colours, 0, 1) * 255).astype(np.uint8)
    if mask is not None:
        opacity = np.clip(as_numpy(mask).astype(np.float32), 0, 1)[..., None]
        pixels = np.concatenate([pixels, np.rint(opacity * 255).astype(np.uint8)], axis=-1)
    return [Image.fromarray(np.ascontiguousarray(row)) for row in pixels]


def on_background(image: Image.Image) -> Image.Image:
    """An opaque RGB copy, white where the image is transparent."""
    if image.mode != "RGBA":
        return image.convert("RGB")
    white = Image.new("RGB", image.size, "white")
    return Image.composite(image.convert("RGB"), white, image.getchannel("A"))


def enlarged(image: Image.Image, width: int) -> Image.Image:
    """The image at ``width`` pixels, aspect kept, by bicubic interpolation (smooth) in either direction."""
    height = max(1, round(image.height * width / image.width))
    return image.resize((width, height), Image.Resampling.BICUBIC)


def image_bytes(image: Image.Image, form: str = "PNG", **how: Any) -> bytes:
    """The file of an image; ``how`` are Pillow's words for that form."""
    stream = BytesIO()
    image.save(stream, format=form, **how)
    return stream.getvalue()


def png_bytes(image: Image.Image) -> bytes:
    """A compact PNG file."""
    return image_bytes(image, optimize=True)
