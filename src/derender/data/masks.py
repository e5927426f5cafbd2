"""Pictures with a mask each: which of CelebAMask-HQ's 19 classes every pixel shows.

A mask in parts is merged as its owners do it (their g_mask.py): the parts are laid over one another in
the order of the classes, so that a later class hides an earlier one. Masks are only ever resized to the
nearest value, after the same crop as their picture's. Which file belongs to which picture is decided in
data/celebamask.py.
"""

import io
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from derender.data.celebamask import MASK_CLASSES, parts_of
from derender.data.decode import DECODER_ERRORS, fit_square, quiet_pillow, upright
from derender.data.inventory import Inventory, take_inventory
from derender.data.loading import Progress, decoding_threads, usable_cores
from derender.data.pictures import PictureSet, read_pictures
from derender.data.source import Source

_CHUNK = 32


class MaskedPictures(NamedTuple):
    """What ``read_masks`` returns.

    Attributes:
        pictures: the pictures with their labels and partition.
        masks: (N, S, S) the class number of every pixel, a row for each picture.
        classes: the name of every class number.
    """

    pictures: PictureSet
    masks: UInt8[np.ndarray, "n s s"]
    classes: tuple[str, ...]


def read_masks(
    source: str | Path,
    image_size: int,
    *,
    dataset: str = "auto",
    subset: str | None = None,
    fit: str = "crop",
    keep_duplicates: bool = False,
    limit: int | None = None,
    cache: str | Path | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> MaskedPictures:
    """Read every picture of a folder or zip with its mask, both at ``image_size`` x ``image_size``.

    The options are those of ``read_pictures``; ``progress`` counts the pictures and then, from the start, the
    masks. A data set without masks is an error, and so is a mask that does not fit its picture: one that is
    missing, has another aspect ratio, is no picture of one channel, or holds a number that is no class.
    """
    inventory = take_inventory(source, dataset=dataset, subset=subset)
    with inventory.source as opened:
        _require_all(inventory)
        pictures = read_pictures(
            source,
            image_size,
            dataset=dataset,
            subset=subset,
            fit=fit,
            keep_duplicates=keep_duplicates,
            limit=limit,
            cache=cache,
            workers=workers,
            progress=progress,
        )
        masks = np.empty((len(pictures), image_size, image_size), np.uint8)
        names, parts = pictures.label("mask"), parts_of(opened)

        def load(start: int) -> int:
            rows = range(start, min(start + _CHUNK, len(pictures)))
            for row in rows:
                masks[row] = _read_mask(opened, pictures.files[row], str(names[row]), parts, image_size, fit)
            return rows.stop

        with quiet_pillow(), decoding_threads(workers or usable_cores()) as pool:
            for done in pool.map(load, range(0, len(pictures), _CHUNK)):
                if progress is not None:
                    progress(done, len(pictures))
    return MaskedPictures(pictures, masks, MASK_CLASSES)


def _require_all(inventory: Inventory) -> None:
    """Every picture has a mask, or an error says how many have none."""
    path, files = inventory.source.path, inventory.table.files
    if "mask" not in inventory.table.labels:
        raise ValueError(
            f"{path} holds no masks (it was read as {inventory.layout.name}): expected images/NAME.jpg with "
            f"masks/NAME.png, or CelebA-HQ-img with CelebAMask-HQ-mask-anno"
        )
    bare = [file for file, mask in zip(files, inventory.table.labels["mask"], strict=True) if not mask]
    if bare:
        raise ValueError(
            f"{len(bare):,} of {len(files):,} pictures in {path} have no mask, the first is {bare[0]!r}; "
            f"add the masks or take these pictures out"
        )


def _read_mask(
    source: Source, picture: str, name: str, parts: dict[str, dict[int, str]], image_size: int, fit: str
) -> UInt8[np.ndarray, "s s"]:
    mask = _merged(source, parts[name]) if name in parts else _class_numbers(source, name)
    width, height = _size_of(source, picture)
    rows, columns = mask.shape
    if abs(columns * height - rows * width) > width + height:
        raise ValueError(
            f"{name} in {source.path} is {columns} x {rows} and its picture {picture} {width} x {height}: "
            f"a mask has the aspect ratio of its picture"
        )
    square = fit_square(Image.fromarray(mask), image_size, fit, Image.Resampling.NEAREST, 0)
    return np.asarray(square)


def _class_numbers(source: Source, file: str) -> UInt8[np.ndarray, "h w"]:
    """A mask that holds class numbers; a palette's colours do not matter."""
    with _opened(source, file) as opened:
        if len(opened.getbands()) > 1:
            raise ValueError(
                f"{file} in {source.path} has {len(opened.getbands())} channels; "
                f"a mask has one, of class numbers"
            )
        values = np.asarray(opened)
    if values.min() < 0 or values.max() >= len(MASK_CLASSES):
        wrong = int(values.min() if values.min() < 0 else values.max())
        raise ValueError(
            f"{file} in {source.path} holds the number {wrong}; classes are 0 ({MASK_CLASSES[0]}) "
            f"to {len(MASK_CLASSES) - 1} ({MASK_CLASSES[-1]})"
        )
    return values.astype(np.uint8)


def _merged(source: Source, files: dict[int, str]) -> UInt8[np.ndarray, "h w"]:
    """The parts of one face over one another, in the order of their class numbers."""
    merged = None
    for number in sorted(files):
        with _opened(source, files[number]) as opened:
            inside = np.asarray(opened.convert("L")) > 0
        rows, columns = inside.shape
        if merged is None:
            merged = np.zeros((rows, columns), np.uint8)
        if merged.shape != (rows, columns):
            raise ValueError(
                f"{files[number]} in {source.path} is {columns} x {rows}, other parts of the face are not"
            )
        merged[inside] = number
    assert merged is not None, "a mask in parts has at least one"
    return merged


def _size_of(source: Source, picture: str) -> tuple[int, int]:
    """Width and height of a picture that was read before, turned as its EXIF orientation says."""
    with Image.open(io.BytesIO(source.read(picture))) as opened:
        return upright(Image.new("1", opened.size), opened).size


def _opened(source: Source, file: str) -> Image.Image:
    try:
        opened = Image.open(io.BytesIO(source.read(file)))
        opened.load()
        return opened
    except DECODER_ERRORS as problem:
        raise ValueError(f"{file} in {source.path} cannot be read: {problem}") from problem
