"""Anybody's own folders: one folder per class, or pictures in any arrangement.

A folder named train, val or test (and the like) around them is read as a partition, not as a class.
"""

from derender.data.layout import PARTITION_NAMES, Layout, Table, pictures_of, text_column
from derender.data.source import Source


def _folders(file: str) -> tuple[str, ...]:
    return tuple(part for part in file.split("/")[:-1] if part not in ("", "."))


def _partition(file: str) -> str:
    """The partition that the outermost folder so named stands for, or ""."""
    return next(
        (PARTITION_NAMES[name.lower()] for name in _folders(file) if name.lower() in PARTITION_NAMES), ""
    )


def _class_folder(file: str) -> str:
    """The folder that the file lies in, unless that is a partition."""
    folders = _folders(file)
    return folders[-1] if folders and folders[-1].lower() not in PARTITION_NAMES else ""


def _is_classes(source: Source) -> bool:
    """Every picture lies in a class folder, all at one depth, and there are two classes or more."""
    depths = {len(_folders(file)) for file in source.pictures}
    classes = {_class_folder(file) for file in source.pictures}
    return len(depths) == 1 and len(classes) >= 2 and "" not in classes


def _read_classes(source: Source, subset: str | None) -> Table:
    table = _read_folder(source, subset)
    return Table(
        table.files, {"class": text_column(_class_folder(file) for file in table.files)}, table.partition
    )


def _read_folder(source: Source, subset: str | None) -> Table:
    files = pictures_of(source, subset)
    partition = text_column(_partition(file) for file in files)
    return Table(files, {}, partition if (partition != "").any() else None)


FOLDERS = (
    Layout("classes", "one folder per class", "", _is_classes, _read_classes),
    Layout("folder", "pictures in any arrangement", "", lambda source: True, _read_folder),
)
