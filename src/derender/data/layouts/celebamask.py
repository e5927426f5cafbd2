"""CelebAMask-HQ: 30,000 faces, each with a mask of 19 classes, as published or with the parts merged.

As published (github.com/switchablenorms/CelebAMask-HQ): ``CelebA-HQ-img/0.jpg`` of 1024 x 1024, and for
every part of a face that is there an image of 512 x 512, ``CelebAMask-HQ-mask-anno/0/00000_skin.png`` (a
folder holds the parts of 2,000 faces). Merged: ``images/0.jpg`` and ``masks/0.png`` of class numbers. The
masks themselves are read by data/masks.py.

``CelebA-HQ-to-CelebA-mapping.txt`` says which image of CelebA each one was, and so its official
partition. The owners' own script compares that table's count from zero with CelebA's numbers, which start
at one; here an image is in the part in which CelebA has it, which moves an image at each border at
most.
"""

from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np

from derender.data.layouts.celeba import attributes_of, partition_of
from derender.data.layouts.layout import (
    MOSTLY,
    Layout,
    Table,
    base_name,
    images_of,
    parent_name,
    part_of,
    read_list,
    text_column,
)
from derender.data.source import Source

HOME = "https://github.com/switchablenorms/CelebAMask-HQ"

MASK_CLASSES = (
    *("background", "skin", "nose", "eye_g", "l_eye", "r_eye", "l_brow", "r_brow", "l_ear", "r_ear"),
    *("mouth", "u_lip", "l_lip", "hair", "hat", "ear_r", "neck_l", "neck", "cloth"),
)
"""The owners' names in their order, which is the class number: eye_g are glasses, ear_r earrings, neck_l a
necklace."""

_IMAGE_FOLDERS = ("CelebA-HQ-img", "images")
_MAPPING = "CelebA-HQ-to-CelebA-mapping.txt"

# CelebA's official parts are runs of its image numbers, from these on
_PARTS = {"test": 182_638, "validation": 162_771, "train": 1}


def parts_of(source: Source) -> dict[str, dict[int, str]]:
    """The files of every mask in parts, by class number, under the mask's name (FOLDER/NUMBER_*.png)."""
    numbers = {name: number for number, name in enumerate(MASK_CLASSES) if number}
    found: dict[str, dict[int, str]] = {}
    for file in source.files:
        if file.endswith(".png"):
            folder, _, name = file.rpartition("/")
            digits, _, part = name.removesuffix(".png").partition("_")
            if part in numbers and digits.isdecimal():
                found.setdefault(f"{folder}/{digits}_*.png", {})[numbers[part]] = file
    return found


def _mask_names(source: Source, images: Sequence[str]) -> list[str]:
    """The mask of each image, "" where there is none: a file, or FOLDER/NUMBER_*.png for one in parts."""
    merged = {
        file.removesuffix(".png"): file
        for file in source.files
        if file.endswith(".png") and parent_name(file) == "masks"
    }
    in_parts = {int(base_name(name).removesuffix("_*.png")): name for name in parts_of(source)}
    names = []
    for path in map(PurePosixPath, images):
        number = int(path.stem) if path.stem.isdecimal() and path.stem.isascii() else -1
        names.append(merged.get(str(path.parent.parent / "masks" / path.stem)) or in_parts.get(number, ""))
    return names


def _images(source: Source, subset: str | None = None) -> tuple[str, ...]:
    for folder in _IMAGE_FOLDERS:
        files = tuple(file for file in source.images if parent_name(file) == folder)
        if files:
            return files if subset is None else tuple(sorted({*files} & {*images_of(source, subset)}))
    return ()


def _is_celebamask(source: Source) -> bool:
    files = _images(source)
    return bool(files) and sum(map(bool, _mask_names(source, files))) >= MOSTLY * len(files)


def _read_celebamask(source: Source, subset: str | None) -> Table:
    """The label ``mask`` names each mask ("" for none); attributes and parts where their lists are there."""
    if not _images(source):
        raise ValueError(
            f"{source.path} has no images of CelebAMask-HQ: expected CelebA-HQ-img/0.jpg, or images/0.jpg; "
            f"the owners publish the set at {HOME}"
        )
    origins = _origins(source)
    files = _images(source, subset if origins is None else None)
    masks = _mask_names(source, files)
    if not any(masks):
        raise ValueError(
            f"{source.path} has images and none of their masks: expected "
            f"CelebAMask-HQ-mask-anno/0/00000_skin.png, or masks/0.png beside images/0.jpg; "
            f"the owners publish them at {HOME}"
        )
    names = [base_name(file) for file in files]
    in_celeba = None if origins is None else [origins.get(name, "") for name in names]
    attributes = attributes_of(source, "CelebAMask-HQ-attribute-anno", names)
    if attributes is None and in_celeba is not None:
        attributes = attributes_of(source, "list_attr_celeba", in_celeba)
    labels = {"mask": text_column(masks), **(attributes or {})}
    if in_celeba is None:
        return Table(files, labels)
    table = Table(files, labels, _official_parts(source, in_celeba))
    return part_of(table, source, subset, _MAPPING)


def _origins(source: Source) -> dict[str, str] | None:
    """The image of CelebA behind each image, both by name, or None without the owners' table."""
    file = source.named(_MAPPING)
    if file is None:
        return None
    expected = "idx orig_idx orig_file, as in 0 119613 119614.jpg"
    header = r"idx\s+orig_idx\s+orig_file"
    rows = read_list(source, file, r"(\d+)\s+\S+\s+(\d+(?:\.\w+)?)", expected, header)
    return {f"{int(number)}.jpg": origin for _, (number, origin) in rows}


def _official_parts(source: Source, origins: Sequence[str]) -> np.ndarray:
    """The part of each image of CelebA: by the list where that is there, else by number: the same."""
    listed = partition_of(source, origins)
    if listed is not None:
        return listed
    numbers = [int(PurePosixPath(name).stem) if name else 0 for name in origins]
    return text_column(
        next((part for part, first in _PARTS.items() if number >= first), "") for number in numbers
    )


CELEBAMASK = Layout(
    "celebamask",
    "CelebAMask-HQ: faces with masks of their parts",
    HOME,
    _is_celebamask,
    _read_celebamask,
    "non-commercial research and education only",
)
