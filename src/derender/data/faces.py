"""Real faces whose labels are in the names of their files: UTKFace, and Labeled Faces in the Wild.

UTKFace: ``[age]_[gender]_[race]_[date].jpg.chip.jpg``. Its owners give no split; the paper's 80/10/10 is
made by data/splits.py. LFW: ``First_Last/First_Last_0001.jpg``; where the lists of its view 1
(``peopleDevTrain.txt``, ``peopleDevTest.txt``: a count, then a name and a count a line) lie beside the
pictures they are the official split by people. The pairs of its verification protocol are not read.
"""

import re
from pathlib import PurePosixPath

import numpy as np

from derender.data.layout import (
    Layout,
    Table,
    number_column,
    part_of,
    pictures_of,
    read_csv,
    text_column,
)
from derender.data.source import Source

_MOSTLY = 0.9  # share of names that must look right: real collections hold a few misnamed files

# In a few published names the race is missing, in one the gender.
_UTK_NAME = re.compile(r"(?P<age>\d{1,3})_(?P<gender>\d?)_(?:(?P<race>\d)_)?\d{8,}")
_UTK_GENDERS = ("male", "female")
_UTK_RACES = ("white", "black", "asian", "indian", "other")
_UTK_OLDEST = 116
_UTK_HOME = "https://susanqq.github.io/UTKFace/"

_LFW_NAME = re.compile(r"(?:.*/)?(?P<identity>[^/]+)/(?P=identity)_\d{4}\.\w+")
_LFW_PARTS = {"peopleDevTrain.txt": "train", "peopleDevTest.txt": "test"}
_LFW_HOME = "https://vis-www.cs.umass.edu/lfw/"


def _name(file: str) -> str:
    return file.rpartition("/")[2]


def _share(files: tuple[str, ...], pattern: re.Pattern[str], whole_path: bool) -> float:
    matched = sum(1 for file in files if pattern.match(file if whole_path else _name(file)))
    return matched / len(files) if files else 0.0


def _is_utkface(source: Source) -> bool:
    return _share(source.pictures, _UTK_NAME, whole_path=False) >= _MOSTLY


def _read_utkface(source: Source, subset: str | None) -> Table:
    """Age, gender and race from the names; values outside the published codes count as unknown."""
    files = pictures_of(source, subset)
    ages, genders, races = [], [], []
    for file in files:
        found = _UTK_NAME.match(_name(file))
        age = float(found["age"]) if found else np.nan
        ages.append(age if age <= _UTK_OLDEST else np.nan)
        genders.append(_coded(found["gender"] if found else None, _UTK_GENDERS))
        races.append(_coded(found["race"] if found else None, _UTK_RACES))
    if files and np.isnan(ages).all():
        raise ValueError(
            f"no picture in {source.path} is named as in UTKFace ([age]_[gender]_[race]_[date].jpg): "
            f"the first is {files[0]!r}; the owners publish the set at {_UTK_HOME}"
        )
    return Table(
        files, {"age": number_column(ages), "gender": text_column(genders), "race": text_column(races)}
    )


def _coded(code: str | None, names: tuple[str, ...]) -> str:
    return names[int(code)] if code and int(code) < len(names) else ""


def _is_lfw(source: Source) -> bool:
    return _share(source.pictures, _LFW_NAME, whole_path=True) >= _MOSTLY


def _read_lfw(source: Source, subset: str | None) -> Table:
    """Identity from the folder; emotion from ``emotions.csv`` (file, emotion) where there is one."""
    partition = _lfw_partition(source)
    files = pictures_of(source, subset if partition is None else None)
    lonely = next((file for file in files if "/" not in file), None)
    if lonely is not None:
        raise ValueError(
            f"LFW has one folder per person, but {lonely} in {source.path} lies in none; "
            f"the owners publish the set at {_LFW_HOME}"
        )
    people = [PurePosixPath(file).parent.name for file in files]
    labels = {"identity": text_column(people)}
    emotions = source.named("emotions.csv")
    if emotions is not None:
        by_name = {row["file"]: row["emotion"] for row in read_csv(source, emotions, ("file", "emotion"))}
        labels["emotion"] = text_column(by_name.get(_name(file), "") for file in files)
    if partition is None:
        return Table(files, labels)
    table = Table(files, labels, text_column(partition.get(person, "") for person in people))
    return part_of(table, source, subset, "peopleDevTrain.txt")


def _lfw_partition(source: Source) -> dict[str, str] | None:
    """The part of each person in the lists of view 1, or None without them."""
    partition: dict[str, str] = {}
    for name, part in _LFW_PARTS.items():
        file = source.named(name)
        if file is None:
            continue
        lines = source.read_text(file).splitlines()
        rows = [line.rsplit(maxsplit=1) for line in lines[1:] if line.strip()]
        if not lines or not lines[0].strip().isdecimal() or len(rows) != int(lines[0]):
            raise ValueError(
                f"{file} in {source.path} is cut short: expected the number of people and as many lines below"
            )
        for number, row in enumerate(rows, 2):
            if len(row) != 2 or not row[1].isdecimal():
                raise ValueError(
                    f"{file} in {source.path}, line {number}: expected a name and a number of pictures"
                )
            partition[row[0]] = part
    return partition or None


FACES = (
    Layout(
        "utkface",
        "UTKFace: faces with age, gender and race in their names",
        _UTK_HOME,
        _is_utkface,
        _read_utkface,
        "non-commercial research only",
    ),
    Layout(
        "lfw",
        "Labeled Faces in the Wild: one folder per person",
        _LFW_HOME,
        _is_lfw,
        _read_lfw,
        "no licence stated; news photographs, collected for research",
    ),
)
