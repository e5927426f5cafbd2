"""Anybody's own folders: one folder per class, or images in any arrangement.

A folder named train, val or test (and the like) around them is read as a partition, not as a class. What a
folder means is worked out once for all of its images, of which there may be millions.
"""

from collections.abc import Callable
from functools import cache

from derender.data.layouts.layout import (
    PARTITION_NAMES,
    Layout,
    Table,
    images_of,
    parent_name,
    partition_by_folder,
    partition_column,
    text_column,
)
from derender.data.source import Source


def _class(file: str) -> str:
    """The name of the folder that a file lies in, unless that is a partition's."""
    name = parent_name(file)
    return "" if name.lower() in PARTITION_NAMES else name


def _by_folder(files: tuple[str, ...], meaning: Callable[[str], str]) -> list[str]:
    """The meaning of the folder of each file."""
    known = cache(lambda folder: meaning(f"{folder}/"))
    return [known(file.rpartition("/")[0]) for file in files]


def _is_classes(source: Source) -> bool:
    """Every image lies in a class folder, all at one depth, and there are two classes or more."""
    folders = {file.rpartition("/")[0] for file in source.images}
    classes = {_class(f"{folder}/") for folder in folders}
    return len({folder.count("/") for folder in folders}) == 1 and len(classes) >= 2 and "" not in classes


def _read_classes(source: Source, subset: str | None) -> Table:
    table = _read_folder(source, subset)
    return Table(table.files, {"class": text_column(_by_folder(table.files, _class))}, table.partition)


def _read_folder(source: Source, subset: str | None) -> Table:
    files = images_of(source, subset)
    return Table(files, partition=partition_column(_by_folder(files, partition_by_folder)))


CLASSES = Layout("classes", "one folder per class", "", _is_classes, _read_classes)
FOLDER = Layout("folder", "images in any arrangement", "", lambda source: True, _read_folder)
