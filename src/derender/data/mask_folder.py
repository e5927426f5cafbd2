"""Pictures of any layout with masks from another folder or zip: one of class numbers for each, named alike.

The mask of ``a/b.jpg`` is ``a/b.png``, or the only ``b.png`` there is. A file ``classes.txt`` among the
masks, or beside their folder as `derender synth` writes it, names the classes, one a line, the first being
number 0; without it they are called after their numbers.
Leaves out colours as classes, and a number for pixels without a class. Masks in CelebAMask-HQ's layouts need
none of this: masks.py.
"""

import io
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from derender.data.decode import DECODER_ERRORS, fit_square, quiet_pillow
from derender.data.loading import Progress
from derender.data.masks import MaskedPictures
from derender.data.pictures import read_pictures
from derender.data.source import Source, open_source

CLASSES_FILE = "classes.txt"
MOST_CLASSES = 255  # 255 itself marks pixels without a class in many sets


def read_mask_folder(
    source: str | Path,
    masks: str | Path,
    image_size: int,
    *,
    dataset: str = "auto",
    fit: str = "crop",
    limit: int | None = None,
    progress: Progress | None = None,
) -> MaskedPictures:
    """Read pictures as ``read_pictures`` does, and the mask of each, at ``image_size`` x ``image_size``.

    A picture without a mask is an error, and so is a mask of more than one channel or with a number that is
    no class.
    """
    pictures = read_pictures(source, image_size, dataset=dataset, fit=fit, limit=limit, progress=progress)
    with open_source(Path(masks).expanduser()) as opened, quiet_pillow():
        names = _mask_names(opened, pictures.files)
        found = np.empty((len(pictures), image_size, image_size), np.uint8)
        for row, name in enumerate(names):
            square = fit_square(_read(opened, name), image_size, fit, Image.Resampling.NEAREST, 0)
            found[row] = np.asarray(square)
            if progress is not None:
                progress(row + 1, len(pictures))
        return MaskedPictures(pictures, found, _class_names(opened, found, names))


def _mask_names(source: Source, pictures: tuple[str, ...]) -> list[str]:
    by_path = {file.removesuffix(".png"): file for file in source.files if file.endswith(".png")}
    by_stem: dict[str, list[str]] = {}
    for path, file in by_path.items():
        by_stem.setdefault(path.rpartition("/")[2], []).append(file)
    names, bare = [], []
    for picture in pictures:
        path = PurePosixPath(picture)
        alike = by_stem.get(path.stem, [])
        name = by_path.get(str(path.with_suffix(""))) or (alike[0] if len(alike) == 1 else None)
        names.append(name or "")
        if name is None:
            bare.append(picture)
    if bare:
        raise ValueError(
            f"{len(bare):,} of {len(pictures):,} pictures have no mask in {source.path}, the first is "
            f"{bare[0]!r}: expected {PurePosixPath(bare[0]).with_suffix('.png')} there"
        )
    return names


def _read(source: Source, name: str) -> Image.Image:
    try:
        opened = Image.open(io.BytesIO(source.read(name)))
        opened.load()
    except DECODER_ERRORS as problem:
        raise ValueError(f"{name} in {source.path} cannot be read: {problem}") from problem
    if len(opened.getbands()) > 1:
        raise ValueError(
            f"{name} in {source.path} has {len(opened.getbands())} channels; a mask has one, of class numbers"
        )
    values = np.asarray(opened)
    if values.max() >= MOST_CLASSES or values.min() < 0:
        raise ValueError(
            f"{name} in {source.path} holds the number {int(values.max())}; classes are 0 to "
            f"{MOST_CLASSES - 1}: give pixels without a class a class of their own"
        )
    return Image.fromarray(values.astype(np.uint8))


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
