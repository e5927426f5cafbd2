"""Real faces: UTKFace, Labeled Faces in the Wild, and RAF-DB.

UTKFace: ``[age]_[gender]_[race]_[date].jpg.chip.jpg``. Its owners give no split; the paper's 80/10/10 is
made by data/splits.py. LFW: ``First_Last/First_Last_0001.jpg``; where the lists of its view 1
(``peopleDevTrain.txt``, ``peopleDevTest.txt``: a count, then a name and a count a line) lie beside the
images they are the official split by people. The pairs of its verification protocol are not read.

RAF-DB, the basic set: ``basic/Image/aligned/train_00001_aligned.jpg`` (100 x 100) and
``basic/EmoLabel/list_patition_label.txt``, spelt so, with a line ``train_00001.jpg 5`` for each image; the
name says the part (12,271 train, 3,068 test). The images before alignment and the compound emotions are not
read.
"""

import re
from pathlib import PurePosixPath

import numpy as np

from derender.data.layouts.layout import (
    MOSTLY,
    Layout,
    Table,
    base_name,
    images_of,
    number_column,
    parent_name,
    part_of,
    read_csv,
    read_list,
    text_column,
)
from derender.data.source import Source

# In a few published names the race is missing, in one the gender.
_UTK_NAME = re.compile(r"(?P<age>\d{1,3})_(?P<gender>\d?)_(?:(?P<race>\d)_)?\d{8,}")
_UTK_GENDERS = ("male", "female")
_UTK_RACES = ("white", "black", "asian", "indian", "other")
_UTK_OLDEST = 116
_UTK_HOME = "https://susanqq.github.io/UTKFace/"

_LFW_NAME = re.compile(r"(?:.*/)?(?P<identity>[^/]+)/(?P=identity)_\d{4}\.\w+")
_LFW_PARTS = {"peopleDevTrain.txt": "train", "peopleDevTest.txt": "test"}
_LFW_HOME = "https://vis-www.cs.umass.edu/lfw/"

_RAF_LISTS = ("list_patition_label.txt", "list_partition_label.txt")
_RAF_HOME = "http://www.whdeng.cn/raf/model1.html"
EMOTIONS = ("surprise", "fear", "disgust", "happiness", "sadness", "anger", "neutral")
"""In the owners' order: 1 is surprise, 7 neutral."""


def _share(files: list[str] | tuple[str, ...], pattern: re.Pattern[str]) -> float:
    return sum(1 for file in files if pattern.match(file)) / len(files) if files else 0.0


def _is_utkface(source: Source) -> bool:
    return _share([base_name(file) for file in source.images], _UTK_NAME) >= MOSTLY


def _read_utkface(source: Source, subset: str | None) -> Table:
    """Age, gender and race from the names; values outside the published codes count as unknown."""
    files = images_of(source, subset)
    ages, genders, races = [], [], []
    for file in files:
        found = _UTK_NAME.match(base_name(file))
        age = float(found["age"]) if found else np.nan
        ages.append(age if age <= _UTK_OLDEST else np.nan)
        genders.append(_coded(found["gender"] if found else None, _UTK_GENDERS))
        races.append(_coded(found["race"] if found else None, _UTK_RACES))
    if files and np.isnan(ages).all():
        raise ValueError(
            f"no image in {source.path} is named as in UTKFace ([age]_[gender]_[race]_[date].jpg): "
            f"the first is {files[0]!r}; the owners publish the set at {_UTK_HOME}"
        )
    return Table(
        files, {"age": number_column(ages), "gender": text_column(genders), "race": text_column(races)}
    )


def _coded(code: str | None, names: tuple[str, ...]) -> str:
    return names[int(code)] if code and int(code) < len(names) else ""


def _read_lfw(source: Source, subset: str | None) -> Table:
    """Identity from the folder; emotion from ``emotions.csv`` (file, emotion) where there is one."""
    partition = _lfw_partition(source)
    files = images_of(source, None if partition else subset)
    lonely = next((file for file in files if "/" not in file), None)
    if lonely is not None:
        raise ValueError(
            f"LFW has one folder per person, but {lonely} in {source.path} lies in none; "
            f"the owners publish the set at {_LFW_HOME}"
        )
    people = [parent_name(file) for file in files]
    labels = {"identity": text_column(people)}
    emotions = source.named("emotions.csv")
    if emotions is not None:
        by_name = {row["file"]: row["emotion"] for row in read_csv(source, emotions, ("file", "emotion"))}
        labels["emotion"] = text_column(by_name.get(base_name(file), "") for file in files)
    if not partition:
        return Table(files, labels)
    table = Table(files, labels, text_column(partition.get(person, "") for person in people))
    return part_of(table, source, subset, "peopleDevTrain.txt")


def _lfw_partition(source: Source) -> dict[str, str]:
    """The part of each person in the lists of view 1; empty without them."""
    partition: dict[str, str] = {}
    for name, part in _LFW_PARTS.items():
        file = source.named(name)
        if file is not None:
            expected = "the number of people, then a name and a number of images a line"
            rows = read_list(source, file, r"(.+?)\s+\d+", expected, header=r"\d+")
            count = int(source.read_text(file).split("\n", 1)[0])
            if len(rows) != count:
                raise ValueError(f"{file} in {source.path} is cut short: {len(rows)} people of {count}")
            partition |= {person: part for _, (person,) in rows}
    return partition


def _raf_list(source: Source) -> str | None:
    """The list of the basic set, shallowest first, or None."""
    found = [file for file in source.files if file.endswith(_RAF_LISTS) and "compound" not in file.split("/")]
    return min(found, key=lambda file: (file.count("/"), file), default=None)


def _read_rafdb(source: Source, subset: str | None) -> Table:
    file = _raf_list(source)
    if file is None:
        raise ValueError(
            f"{source.path} has no EmoLabel/list_patition_label.txt (the owners' spelling), as RAF-DB's "
            f"basic set has; the owners send the set on request: {_RAF_HOME}"
        )
    expected = f"an image and an emotion from 1 ({EMOTIONS[0]}) to {len(EMOTIONS)} ({EMOTIONS[-1]})"
    rows = read_list(source, file, rf"(\S.*) ([1-{len(EMOTIONS)}])", expected)
    emotions = {PurePosixPath(name.strip()).stem: EMOTIONS[int(code) - 1] for _, (name, code) in rows}
    files = tuple(name for name in source.images if PurePosixPath(name).stem.endswith("_aligned"))
    if not files:
        raise ValueError(
            f"{source.path} has RAF-DB's list of emotions and no aligned images: expected "
            f"Image/aligned/train_00001_aligned.jpg; unpack aligned.zip into a folder of its name"
        )
    names = [PurePosixPath(name).stem.removesuffix("_aligned") for name in files]
    if not emotions.keys() & set(names):
        raise ValueError(f"{file} in {source.path} names none of its images; the first is {files[0]!r}")
    parts = (name.partition("_")[0] for name in names)
    table = Table(
        files,
        {"emotion": text_column(emotions.get(name, "") for name in names)},
        text_column(part if part in ("train", "test") else "" for part in parts),
    )
    return part_of(table, source, subset, "a name such as test_0001_aligned.jpg")


UTKFACE = Layout(
    "utkface",
    "UTKFace: faces with age, gender and race in their names",
    _UTK_HOME,
    _is_utkface,
    _read_utkface,
    "non-commercial research only",
)
LFW = Layout(
    "lfw",
    "Labeled Faces in the Wild: one folder per person",
    _LFW_HOME,
    lambda source: _share(source.images, _LFW_NAME) >= MOSTLY,
    _read_lfw,
    "no licence stated; news photographs, collected for research",
)
RAFDB = Layout(
    "rafdb",
    "RAF-DB: faces with one of seven emotions",
    _RAF_HOME,
    lambda source: _raf_list(source) is not None,
    _read_rafdb,
    "non-commercial research only, on request",
)
