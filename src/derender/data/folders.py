"""Anybody's own folders: one folder per class, or pictures in any arrangement.

A folder named train, val or test (and the like) around them is read as a partition, not as a class. What a
folder means is worked out once for all of its pictures, of which there may be millions.
"""

from collections.abc import Callable, Iterable
from functools import cache

from derender.data.layout import PARTITION_NAMES, Layout, Table, pictures_of, text_column
from derender.data.source import Source


def _folders(folder: str) -> tuple[str, ...]:
    return tuple(part for part in folder.split("/") if part not in ("", "."))


def _partition(folder: str) -> str:
    """The partition that the outermost folder so named stands for, or ""."""
    return next(
        (PARTITION_NAMES[name.lower()] for name in _folders(folder) if name.lower() in PARTITION_NAMES), ""
    )


def _class_folder(folder: str) -> str:
    """The name of the folder, unless that is a partition's."""
    folders = _folders(folder)
    return folders[-1] if folders and folders[-1].lower() not in PARTITION_NAMES else ""


def _of_folders(files: Iterable[str], meaning: Callable[[str], str]) -> list[str]:
    """What the folder of each file means."""
    known = cache(meaning)
    return [known(file.rpartition("/")[0]) for file in files]


def _is_classes(source: Source) -> bool:
    """Every picture lies in a class folder, all at one depth, and there are two classes or more."""
    folders = {file.rpartition("/")[0] for file in source.pictures}
    depths = {len(_folders(folder)) for folder in folders}
    classes = {_class_folder(folder) for folder in folders}
    return len(depths) == 1 and len(classes) >= 2 and "" not in classes


def _read_classes(source: Source, subset: str | None) -> Table:
    table = _read_folder(source, subset)
    return Table(
        table.files, {"class": text_column(_of_folders(table.files, _class_folder))}, table.partition
    )


def _read_folder(source: Source, subset: str | None) -> Table:
    files = pictures_of(source, subset)
    partition = _of_folders(files, _partition)
    return Table(files, {}, text_column(partition) if any(partition) else None)


FOLDERS = (
    Layout("classes", "one folder per class", "", _is_classes, _read_classes),
    Layout("folder", "pictures in any arrangement", "", lambda source: True, _read_folder),
)
