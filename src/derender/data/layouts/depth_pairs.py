"""Images with depth maps in folders side by side, as unsup3d's synthetic faces lie.

    SET/image/NAME.png          the image; SET is train, val or test, or nothing
    SET/depth/NAME.png          its depth map, NAME the same or with "image" replaced by "depth"

A map is a grey PNG. Its value, as a share v of the largest (255 or 65,535), is nearness: z = 1.1 - 0.2 v, so
that the nearest surface that the model can predict is white, and 0 is background. Depth is z in the camera
frame of the image, at 10 degrees of field of view. The set's own words do not say this, and
the archive could not be had to check it: look at the average depth first, for which unsup3d gives SIDE
1.990e-2 and MAD 23.26 degrees. SIDE ignores a global scale but not the range; ``read_depth`` takes another
one.

Maps are shrunk together with their images, by area, over the object's pixels alone. Leaves out light,
camera, albedo and normals: the set has none.
"""

from pathlib import PurePosixPath

import numpy as np
from jaxtyping import Bool, Float32
from PIL import Image

from derender.data.image import opened_image
from derender.data.layouts.layout import (
    PARTITION_NAMES,
    Layout,
    Table,
    one_of,
    parent_name,
    partition_column,
)
from derender.data.source import Source

DEPTH_RANGE = (0.9, 1.1)
_IMAGE, _DEPTH = "image", "depth"


def pairs_of(source: Source) -> dict[str, str]:
    """Image to depth map, for every image in a folder ``image`` with a map in the folder beside it."""
    images = _images(source)
    known, found = set(source.files) if images else set(), {}
    for file in images:
        path = PurePosixPath(file)
        folder = path.parent.parent / _DEPTH
        for stem in (path.stem.replace(_IMAGE, _DEPTH), path.stem):
            name = str(folder / f"{stem}.png")
            if name in known:
                found[file] = name
                break
    return found


def _images(source: Source) -> list[str]:
    """The images in folders ``image``."""
    return [file for file in source.images if parent_name(file) == _IMAGE]


def _subset(file: str) -> str:
    """The folder around ``image``: "train", "val", "test", or "" for none."""
    return parent_name(file.rpartition("/")[0])


def subset_pairs(source: Source, subset: str | None) -> dict[str, str]:
    """The pairs of one subset; by default ``test``, or the only one there is."""
    pairs = pairs_of(source)
    subset = one_of(source, subset, "test", sorted({_subset(file) for file in pairs}))
    return {file: depth for file, depth in pairs.items() if _subset(file) == subset}


def read_depth(
    source: Source, file: str, image_size: int | None, depth_range: tuple[float, float] = DEPTH_RANGE
) -> tuple[Float32[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """One depth map, z with 0 for background, and where the object is; square ``image_size`` if given."""
    opened = opened_image(source, file)
    mode, code = opened.mode, np.asarray(opened)
    if code.ndim == 3 and mode == "RGB" and (code == code[..., :1]).all():
        code = code[..., 0]
    if code.ndim != 2 or mode not in ("L", "RGB", "I;16", "I"):
        raise ValueError(
            f"{file} in {source.path} is {mode} {code.shape}; a depth map is a grey PNG of 8 or 16 bits"
        )
    largest = 255 if code.dtype == np.uint8 else 65_535
    near, far = depth_range
    mask = code > 0
    depth = np.where(mask, far - (far - near) * (code / largest), 0).astype(np.float32)
    return (depth, mask) if image_size is None else _shrunk(depth, mask, image_size)


def _shrunk(
    depth: Float32[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"], size: int
) -> tuple[Float32[np.ndarray, "s s"], Bool[np.ndarray, "s s"]]:
    """Mean depth of the object in each new pixel; a pixel is on the object where more than half of it is."""
    if depth.shape == (size, size):
        return depth, mask

    def by_area(values: np.ndarray) -> np.ndarray:
        image = Image.fromarray(values.astype(np.float32))
        return np.asarray(image.resize((size, size), Image.Resampling.BOX))

    share = by_area(mask)
    small = share > 0.5
    return np.where(small, by_area(depth) / np.where(small, share, 1), 0).astype(np.float32), small


def _is_paired(source: Source) -> bool:
    """Every image in a folder ``image`` has its depth map, and there is at least one."""
    images = _images(source)
    return bool(images) and len(pairs_of(source)) == len(images)


def _read_paired(source: Source, subset: str | None) -> Table:
    """The images without their maps, with the owners' split where the folders give one."""
    files = tuple(pairs_of(source) if subset is None else subset_pairs(source, subset))
    partition = partition_column(PARTITION_NAMES.get(_subset(file).lower(), "") for file in files)
    return Table(files, partition=partition)


DEPTH_PAIRS = Layout(
    "depth_pairs",
    "images and depth maps: image/NAME.png, depth/NAME.png",
    "https://github.com/elliottwu/unsup3d",
    _is_paired,
    _read_paired,
    "see its owners' page",
)
