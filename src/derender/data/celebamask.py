"""CelebAMask-HQ: 30,000 faces, each with a mask of 19 classes, as published or with the parts merged.

As published (github.com/switchablenorms/CelebAMask-HQ): ``CelebA-HQ-img/0.jpg`` of 1024 x 1024, and for
every part of a face that is there a picture of 512 x 512, ``CelebAMask-HQ-mask-anno/0/00000_skin.png`` (a
folder holds the parts of 2,000 faces). Merged: ``images/0.jpg`` and ``masks/0.png`` of class numbers. The
masks themselves are read by data/masks.py.

``CelebA-HQ-to-CelebA-mapping.txt`` says which picture of CelebA each one was, and so its official
partition. The owners' own script compares that table's count from zero with CelebA's numbers, which start
at one; here a picture is in the part in which CelebA has it, which moves a picture at each border at
most.
"""

from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np

from derender.data.celeba import attribute_labels, partition_of, read_listing
from derender.data.layout import Labels, Layout, Table, part_of, pictures_of, text_column
from derender.data.source import Source

HOME = "https://github.com/switchablenorms/CelebAMask-HQ"

MASK_CLASSES = (
    *("background", "skin", "nose", "eye_g", "l_eye", "r_eye", "l_brow", "r_brow", "l_ear", "r_ear"),
    *("mouth", "u_lip", "l_lip", "hair", "hat", "ear_r", "neck_l", "neck", "cloth"),
)
"""The owners' names in their order, which is the class number: eye_g are glasses, ear_r earrings, neck_l a
necklace."""

_MOSTLY = 0.9  # share of pictures that must have a mask for the layout to be recognised
_PICTURE_FOLDERS = ("CelebA-HQ-img", "images")

# CelebA's official parts are runs of its picture numbers: the last of train and of validation
_LAST_OF_TRAIN, _LAST_OF_VALIDATION = 162_770, 182_637


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


def _mask_names(source: Source, pictures: Sequence[str]) -> list[str]:
    """The mask of each picture, "" where there is none: a file, or FOLDER/NUMBER_*.png for one in parts."""
    merged = {
        file.removesuffix(".png"): file
        for file in source.files
        if file.endswith(".png") and f"/{file}".rsplit("/", 2)[1] == "masks"
    }
    in_parts = {int(name.rpartition("/")[2].removesuffix("_*.png")): name for name in parts_of(source)}
    names = []
    for path in map(PurePosixPath, pictures):
        number = int(path.stem) if path.stem.isdecimal() and path.stem.isascii() else -1
        names.append(merged.get(str(path.parent.parent / "masks" / path.stem)) or in_parts.get(number, ""))
    return names


def _pictures(source: Source, subset: str | None = None) -> tuple[str, ...]:
    for folder in _PICTURE_FOLDERS:
        likely = (file for file in source.pictures if f"{folder}/" in file)
        files = tuple(file for file in likely if f"/{file}".rsplit("/", 2)[1] == folder)
        if files:
            inside = pictures_of(source, subset)
            return files if subset is None else tuple(sorted(set(files) & set(inside)))
    return ()


def _is_celebamask(source: Source) -> bool:
    files = _pictures(source)
    return bool(files) and sum(map(bool, _mask_names(source, files))) >= _MOSTLY * len(files)


def _read_celebamask(source: Source, subset: str | None) -> Table:
    """The label ``mask`` names each mask ("" for none); attributes and parts where their lists are there."""
    if not _pictures(source):
        raise ValueError(
            f"{source.path} has no pictures of CelebAMask-HQ: expected CelebA-HQ-img/0.jpg, or images/0.jpg; "
            f"the owners publish the set at {HOME}"
        )
    origins = _origins(source)
    by_folder = subset if subset is not None and origins is None else None
    files = _pictures(source, by_folder)
    masks = _mask_names(source, files)
    if not any(masks):
        raise ValueError(
            f"{source.path} has pictures and none of their masks: expected "
            f"CelebAMask-HQ-mask-anno/0/00000_skin.png, or masks/0.png beside images/0.jpg; "
            f"the owners publish them at {HOME}"
        )
    labels: Labels = {"mask": text_column(masks)}
    names = [PurePosixPath(file).name for file in files]
    own = read_listing(source, "CelebAMask-HQ-attribute-anno")
    celeba = read_listing(source, "list_attr_celeba")
    if own is not None:
        labels |= attribute_labels(source, own, names)
    elif celeba is not None and origins is not None:
        labels |= attribute_labels(source, celeba, [origins.get(name, "") for name in names])
    if origins is None:
        return Table(files, labels)
    table = Table(files, labels, _official_parts(source, [origins.get(name, "") for name in names]))
    return part_of(table, source, subset, "CelebA-HQ-to-CelebA-mapping.txt")


def _origins(source: Source) -> dict[str, str] | None:
    """The picture of CelebA behind each picture, both by name, or None without the owners' table."""
    file = source.named("CelebA-HQ-to-CelebA-mapping.txt")
    if file is None:
        return None
    rows = [line.split() for line in source.read_text(file).splitlines()]
    wrong = next(
        (
            number
            for number, row in enumerate(rows[1:], 2)
            if row and not (len(row) == 3 and row[0].isdecimal() and PurePosixPath(row[2]).stem.isdecimal())
        ),
        None,
    )
    if wrong is not None or not rows or rows[0] != ["idx", "orig_idx", "orig_file"]:
        raise ValueError(
            f"{file} in {source.path}, line {wrong or 1}: expected idx orig_idx orig_file, "
            f"as in 0 119613 119614.jpg"
        )
    return {f"{int(row[0])}.jpg": row[2] for row in rows[1:] if row}


def _official_parts(source: Source, origins: Sequence[str]) -> np.ndarray:
    """The part of each picture of CelebA: by the list where that is there, else by number: the same."""
    listed = partition_of(source, origins)
    if listed is not None:
        return listed
    numbers = [int(PurePosixPath(name).stem) if name else 0 for name in origins]
    return text_column(
        ""
        if not number
        else "train"
        if number <= _LAST_OF_TRAIN
        else "validation"
        if number <= _LAST_OF_VALIDATION
        else "test"
        for number in numbers
    )


CELEBAMASK = Layout(
    "celebamask",
    "CelebAMask-HQ: faces with masks of their parts",
    HOME,
    _is_celebamask,
    _read_celebamask,
    "non-commercial research and education only",
)
