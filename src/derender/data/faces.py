"""Published collections of real faces: UTKFace, LFW, CelebA, and CelebAMask-HQ as picture and mask pairs.

All are for non-commercial research only; none is part of this package. The masks themselves are read
elsewhere.
"""

import re
from pathlib import PurePosixPath

import numpy as np

from derender.data.layout import (
    Layout,
    Table,
    number_column,
    pictures_of,
    read_csv,
    text_column,
)
from derender.data.source import Source

_MOSTLY = 0.9  # share of names that must look right: real collections hold a few misnamed files

# UTKFace: [age]_[gender]_[race]_[date].jpg.chip.jpg; in a few names the race is missing.
_UTK_NAME = re.compile(r"(?P<age>\d{1,3})_(?P<gender>\d)_(?:(?P<race>\d)_)?\d{8,}")
_UTK_GENDERS = ("male", "female")
_UTK_RACES = ("white", "black", "asian", "indian", "other")

# LFW: a folder per person, and that person's name and a number in each file's name
_LFW_NAME = re.compile(r"(?:.*/)?(?P<identity>[^/]+)/(?P=identity)_\d{4}\.\w+")

_CELEBA_PARTITIONS = {"0": "train", "1": "validation", "2": "test"}


def _share(files: tuple[str, ...], pattern: re.Pattern[str], whole_path: bool) -> float:
    matched = sum(1 for file in files if pattern.match(file if whole_path else PurePosixPath(file).name))
    return matched / len(files) if files else 0.0


def _is_utkface(source: Source) -> bool:
    return _share(source.pictures, _UTK_NAME, whole_path=False) >= _MOSTLY


def _read_utkface(source: Source, subset: str | None) -> Table:
    """Age, gender and race from the names; values outside the published codes count as unknown."""
    files = pictures_of(source, subset)
    ages, genders, races = [], [], []
    for file in files:
        found = _UTK_NAME.match(PurePosixPath(file).name)
        ages.append(float(found["age"]) if found else np.nan)
        genders.append(_coded(found["gender"] if found else None, _UTK_GENDERS))
        races.append(_coded(found["race"] if found else None, _UTK_RACES))
    if files and np.isnan(ages).all():
        raise ValueError(
            f"no picture in {source.path} is named as in UTKFace "
            f"([age]_[gender]_[race]_[date].jpg): the first is {files[0]!r}"
        )
    return Table(
        files, {"age": number_column(ages), "gender": text_column(genders), "race": text_column(races)}
    )


def _coded(code: str | None, names: tuple[str, ...]) -> str:
    return names[int(code)] if code is not None and int(code) < len(names) else ""


def _is_lfw(source: Source) -> bool:
    return _share(source.pictures, _LFW_NAME, whole_path=True) >= _MOSTLY


def _read_lfw(source: Source, subset: str | None) -> Table:
    """Identity from the folder; emotion from ``emotions.csv`` (file, emotion) where there is one."""
    files = pictures_of(source, subset)
    lonely = next((file for file in files if "/" not in file), None)
    if lonely is not None:
        raise ValueError(f"LFW has one folder per person, but {lonely} in {source.path} lies in none")
    labels = {"identity": text_column(PurePosixPath(file).parent.name for file in files)}
    emotions = source.named("emotions.csv")
    if emotions is not None:
        by_name = {row["file"]: row["emotion"] for row in read_csv(source, emotions, ("file", "emotion"))}
        labels["emotion"] = text_column(by_name.get(PurePosixPath(file).name, "") for file in files)
    return Table(files, labels)


def _is_celeba(source: Source) -> bool:
    return (
        source.named("list_attr_celeba.txt") is not None or source.named("list_attr_celeba.csv") is not None
    )


def _read_celeba(source: Source, subset: str | None) -> Table:
    """The 40 attributes, and identity and the official partition where their files are there."""
    files = source.pictures
    aligned = tuple(file for file in files if "img_align_celeba" in PurePosixPath(file).parts[:-1])
    files = aligned or files
    names = [PurePosixPath(file).name for file in files]
    attributes, by_name = _celeba_attributes(source)
    unknown = np.full(len(attributes), -1, np.int8)
    values = (
        np.stack([by_name.get(name, unknown) for name in names])
        if names
        else np.zeros((0, len(attributes)), np.int8)
    )
    labels = {name: values[:, column].copy() for column, name in enumerate(attributes)}
    identities = _celeba_pairs(source, "identity_CelebA.txt")
    if identities is not None:
        labels["identity"] = text_column(identities.get(name, "") for name in names)
    partitions = _celeba_pairs(source, "list_eval_partition.txt")
    partition = None
    if partitions is not None:
        partition = text_column(_CELEBA_PARTITIONS.get(partitions.get(name, ""), "") for name in names)
    table = Table(files, labels, partition)
    if subset is None:
        return table
    if partition is None or subset not in _CELEBA_PARTITIONS.values():
        raise ValueError(
            f"CelebA's subsets are train, validation and test, and need list_eval_partition.txt; "
            f"asked for {subset!r} of {source.path}"
        )
    return table.select(np.flatnonzero(partition == subset))


def _celeba_attributes(source: Source) -> tuple[list[str], dict[str, np.ndarray]]:
    """Attribute names, and 0/1 values by picture name, from the original text file or its CSV copy."""
    file = source.named("list_attr_celeba.txt") or source.named("list_attr_celeba.csv")
    if file is None:
        raise ValueError(
            f"{source.path} has no list_attr_celeba.txt; CelebA's owners publish it at {_CELEBA_HOME}"
        )
    lines = source.read_text(file).splitlines()
    if len(lines) < 2:
        raise ValueError(
            f"{file} in {source.path} is cut short: expected the attribute names and rows below them"
        )
    if file.endswith(".csv"):
        head, body, first = lines[0].split(",")[1:], [line.split(",") for line in lines[1:]], 2
    else:
        head, body, first = lines[1].split(), [line.split() for line in lines[2:]], 3
    by_name = {}
    for number, row in enumerate(body, first):
        if not row:
            continue
        if len(row) != len(head) + 1 or any(value not in ("-1", "0", "1") for value in row[1:]):
            raise ValueError(
                f"{file} in {source.path}, line {number}: expected a name and {len(head)} values of -1 or 1"
            )
        by_name[row[0]] = np.array([value == "1" for value in row[1:]], np.int8)
    return head, by_name


def _celeba_pairs(source: Source, file: str) -> dict[str, str] | None:
    """``name value`` lines, or None when the file is not there."""
    found = source.named(file)
    if found is None:
        return None
    rows = (line.split() for line in source.read_text(found).splitlines())
    return {row[0]: row[1] for row in rows if len(row) == 2}


def _is_celebamask(source: Source) -> bool:
    pictured = sum(1 for file in source.pictures if _in(file, "images"))
    return pictured > 0 and len(_mask_pairs(source)) >= _MOSTLY * pictured


def _read_celebamask(source: Source, subset: str | None) -> Table:
    """The pictures that have a mask; the label ``mask`` names the mask's file."""
    pairs = {
        file: mask
        for file, mask in _mask_pairs(source).items()
        if subset is None or subset in file.split("/")
    }
    if not pairs:
        raise ValueError(f"{source.path} has no pairs images/NAME.jpg and masks/NAME.png")
    return Table(tuple(pairs), {"mask": text_column(pairs.values())})


def _in(file: str, folder: str) -> bool:
    return PurePosixPath(file).parent.name == folder


def _mask_pairs(source: Source) -> dict[str, str]:
    masks = {
        PurePosixPath(file).stem: file
        for file in source.files
        if _in(file, "masks") and file.endswith(".png")
    }
    pictures = [file for file in source.pictures if _in(file, "images")]
    return {file: masks[PurePosixPath(file).stem] for file in pictures if PurePosixPath(file).stem in masks}


_CELEBA_HOME = "https://mmlab.ie.cuhk.edu.hk/projects/CelebA.html"

FACES = (
    Layout("celeba", "CelebA: faces with 40 attributes", _CELEBA_HOME, _is_celeba, _read_celeba),
    Layout(
        "celebamask",
        "CelebAMask-HQ: faces with masks of their parts",
        "https://github.com/switchablenorms/CelebAMask-HQ",
        _is_celebamask,
        _read_celebamask,
    ),
    Layout(
        "utkface",
        "UTKFace: faces with age, gender and race in their names",
        "https://susanqq.github.io/UTKFace/",
        _is_utkface,
        _read_utkface,
    ),
    Layout(
        "lfw",
        "Labeled Faces in the Wild: one folder per person",
        "https://vis-www.cs.umass.edu/lfw/",
        _is_lfw,
        _read_lfw,
    ),
)
