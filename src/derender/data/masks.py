"""Images with a mask each: which class every pixel shows.

Masks lie in the data set itself (CelebAMask-HQ, rendered sets), or in another folder or zip beside images
of any layout: one of class numbers for each, named alike. Masks are only ever resized to the nearest value,
after the same crop as their image's. A mask in parts is merged as CelebAMask-HQ's owners do it (their
g_mask.py): the parts are laid over one another in the order of the classes, so that a later class hides an
earlier one. Leaves out colours as classes, and a number for pixels without a class.
"""

import io
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from derender.data.decoding import Progress, usable_cores
from derender.data.image import fit_square, opened_image, quiet_pillow, upright_size
from derender.data.image_set import ImageSet, read_images
from derender.data.layouts.celebamask import MASK_CLASSES, parts_of
from derender.data.opening import ListedStream, list_images, open_source
from derender.data.source import Source

CLASSES_FILE = "classes.txt"
MOST_CLASSES = 255  # 255 itself marks pixels without a class in many sets


class MaskedImages(NamedTuple):
    """What ``read_masks`` returns.

    Attributes:
        images: the images with their labels and partition.
        masks: (N, S, S) the class number of every pixel, a row for each image.
        classes: the name of every class number.
    """

    images: ImageSet
    masks: UInt8[np.ndarray, "n s s"]
    classes: tuple[str, ...]


def read_masks(
    source: str | Path,
    image_size: int,
    *,
    masks: str | Path | None = None,
    dataset: str = "auto",
    subset: str | None = None,
    fit: str = "crop",
    keep_duplicates: bool = False,
    limit: int | None = None,
    cache: str | Path | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> MaskedImages:
    """Read every image of a folder or zip with its mask, both at ``image_size`` x ``image_size``.

    The other options are those of ``read_images``; ``progress`` counts the images and then, from the start,
    the masks. A data set without masks is an error, and so is a mask that does not fit its image: one that is
    missing, is no image of one channel, or holds a number that is no class.

    Args:
        masks: a folder or zip with a mask for every image: that of ``a/b.jpg`` is ``a/b.png``, or the only
            ``b.png`` there is. A file ``classes.txt`` among them, or beside their folder as `derender synth`
            writes it, names the classes, one a line, the first being number 0; else they are called
            after their numbers. None takes the data set's own masks, with CelebAMask-HQ's classes and the
            aspect ratio of their images.
    """
    if masks is None:
        listed = list_images(source, dataset=dataset, subset=subset)
        files, parts, classes = listed.files, parts_of(listed.files), len(MASK_CLASSES)
        limits = f"0 ({MASK_CLASSES[0]}) to {classes - 1} ({MASK_CLASSES[-1]})"
    else:
        listed, files, parts, classes = None, open_source(Path(masks).expanduser()), {}, MOST_CLASSES
        limits = f"0 to {classes - 1}: give pixels without a class a class of their own"
    with files:
        if listed is not None:
            _require_all(listed)
        how = {"dataset": dataset, "subset": subset, "fit": fit, "keep_duplicates": keep_duplicates}
        how |= {"limit": limit, "cache": cache, "workers": workers, "progress": progress}
        pictures = read_images(source, image_size, **how)
        names = _named_alike(files, pictures.files) if listed is None else pictures.label("mask").tolist()
        found = np.empty((len(pictures), image_size, image_size), np.uint8)

        def load(row: int) -> None:
            name = names[row]
            merged = _merged(files, parts[name]) if name in parts else None
            mask = _numbers(files, name, classes, limits) if merged is None else merged
            if listed is not None:
                _check_shape(files, name, mask.shape, pictures.files[row])
            square = fit_square(Image.fromarray(mask), image_size, fit, Image.Resampling.NEAREST, 0)
            found[row] = np.asarray(square)

        pool = ThreadPoolExecutor(workers or usable_cores())
        try:
            with quiet_pillow():
                for done, _ in enumerate(pool.map(load, range(len(pictures))), 1):
                    if progress is not None:
                        progress(done, len(pictures))
        finally:
            pool.shutdown(cancel_futures=True)
        names_of_classes = MASK_CLASSES if listed is not None else _class_names(files, found, names)
    return MaskedImages(pictures, found, names_of_classes)


def _check_shape(files: Source, name: str, shape: tuple[int, ...], image: str) -> None:
    """A mask has the aspect ratio of its image."""
    with Image.open(io.BytesIO(files.read(image))) as opened:
        width, height = upright_size(opened)
    rows, columns = shape
    if abs(columns * height - rows * width) > width + height:
        raise ValueError(
            f"{name} in {files.path} is {columns} x {rows} and its image {image} {width} x {height}: "
            f"a mask has the aspect ratio of its image"
        )


def _require_all(listed: ListedStream) -> None:
    """Every image has a mask, or an error says how many have none."""
    path, table = listed.files.path, listed.table
    if "mask" not in table.labels:
        raise ValueError(
            f"{path} holds no masks (it was read as {listed.layout}): expected images/NAME.jpg with "
            f"masks/NAME.png, or CelebA-HQ-img with CelebAMask-HQ-mask-anno"
        )
    bare = [file for file, mask in zip(table.files, table.labels["mask"], strict=True) if not mask]
    if bare:
        raise ValueError(
            f"{len(bare):,} of {len(table.files):,} images in {path} have no mask, the first is {bare[0]!r}; "
            f"add the masks or take these images out"
        )


def _numbers(source: Source, file: str, classes: int, limits: str) -> UInt8[np.ndarray, "h w"]:
    """A mask that holds class numbers; a palette's colours do not matter."""
    opened = opened_image(source, file)
    if len(opened.getbands()) > 1:
        raise ValueError(
            f"{file} in {source.path} has {len(opened.getbands())} channels; a mask has one, of class numbers"
        )
    values = np.asarray(opened)
    if values.min() < 0 or values.max() >= classes:
        wrong = int(values.min() if values.min() < 0 else values.max())
        raise ValueError(f"{file} in {source.path} holds the number {wrong}; classes are {limits}")
    return values.astype(np.uint8)


def _merged(source: Source, files: dict[int, str]) -> UInt8[np.ndarray, "h w"]:
    """The parts of one face, at least one, over one another, in the order of their class numbers."""
    merged = None
    for number in sorted(files):
        inside = np.asarray(opened_image(source, files[number]).convert("L")) > 0
        rows, columns = inside.shape
        if merged is None:
            merged = np.zeros((rows, columns), np.uint8)
        if merged.shape != (rows, columns):
            raise ValueError(
                f"{files[number]} in {source.path} is {columns} x {rows}, other parts of the face are not"
            )
        merged[inside] = number
    assert merged is not None
    return merged


def _named_alike(source: Source, images: tuple[str, ...]) -> list[str]:
    by_path = {file.removesuffix(".png"): file for file in source.files if file.endswith(".png")}
    by_stem: dict[str, list[str]] = {}
    for path, file in by_path.items():
        by_stem.setdefault(path.rpartition("/")[2], []).append(file)
    names, bare = [], []
    for image in images:
        path = PurePosixPath(image)
        alike = by_stem.get(path.stem, [])
        name = by_path.get(str(path.with_suffix(""))) or (alike[0] if len(alike) == 1 else None)
        names.append(name or "")
        if name is None:
            bare.append(image)
    if bare:
        raise ValueError(
            f"{len(bare):,} of {len(images):,} images have no mask in {source.path}, the first is "
            f"{bare[0]!r}: expected {PurePosixPath(bare[0]).with_suffix('.png')} there"
        )
    return names


def _class_names(source: Source, masks: UInt8[np.ndarray, "n s s"], files: list[str]) -> tuple[str, ...]:
    largest = masks.max(axis=(1, 2))
    listed, beside = source.named(CLASSES_FILE), source.path.parent / CLASSES_FILE
    if listed is not None:
        text = source.read_text(listed)
    elif source.path.is_dir() and beside.is_file():
        listed, text = str(beside), beside.read_text(encoding="utf-8", errors="replace")
    else:
        return tuple(f"class {number}" for number in range(int(largest.max()) + 1))
    names = tuple(line.strip() for line in text.splitlines() if line.strip())
    if int(largest.max()) >= len(names):
        file = files[int(largest.argmax())]
        raise ValueError(
            f"{file} in {source.path} holds the number {int(largest.max())}; {listed} names "
            f"{len(names)} classes"
        )
    return names
