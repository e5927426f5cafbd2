"""How data sets lie: the list of layouts, most particular first, a row each; and anybody's own folders.

A table that somebody laid beside images comes first: it says what they are. Of folders, one named train, val
or test (and the like) is read as a partition, not as a class.
"""

from posixpath import basename

from derender.data.layouts import faces, rendered, tables
from derender.data.layouts.layout import TOLD, Layout, Table, mostly, partition_named, partitions, text_column
from derender.data.source import Source, parent_name
from derender.storage.places import require_known


def _class(file: str) -> str:
    """The name of the folder that a file lies in, unless that is a partition's."""
    name = parent_name(file)
    return "" if partition_named([name]) else name


def _is_classes(source: Source) -> bool:
    """Every image lies in a class folder, all at one depth, and there are two classes or more."""
    folders = {file.rpartition("/")[0] for file in source.images}
    classes = {_class(f"{folder}/") for folder in folders}
    return len({folder.count("/") for folder in folders}) == 1 and len(classes) >= 2 and "" not in classes


def _load_folder(source: Source) -> Table:
    return Table(source.images, partition=partitions(source.images))


def _load_classes(source: Source) -> Table:
    labels = {"class": text_column(map(_class, source.images))}
    return Table(source.images, labels, _load_folder(source).partition)


_READERS = {  # by name: whether a source looks like the layout, and the table of its images
    "table": (tables.is_listed, tables.load_listed),
    "syncar": (lambda source: "class" in rendered.columns(source), rendered.load_rendered),
    "synface": (lambda source: "file" in rendered.columns(source), rendered.load_rendered),
    "synface_tracks": (rendered.is_tracks, rendered.load_tracks),
    "depth_pairs": (rendered.is_paired, rendered.load_pairs),
    "rafdb": (lambda source: faces.raf_list(source) is not None, faces.load_rafdb),
    "celebamask": (lambda source: mostly(bool, faces.mask_names(source).values()), faces.load_celebamask),
    "celeba": (faces.is_celeba, faces.load_celeba),
    "utkface": (lambda source: mostly(faces.UTK_NAME.match, map(basename, source.images)), faces.load_utk),
    "yaleb": (lambda source: mostly(faces.YALE_NAME.match, map(basename, source.images)), faces.load_yale),
    "lfw": (lambda source: mostly(faces.LFW_NAME.match, source.images), faces.load_lfw),
    "shapenet_cars": (rendered.is_cars, rendered.load_cars),
    "face_tracks": (faces.is_tracks, faces.load_tracks),
    "classes": (_is_classes, _load_classes),
    "folder": (lambda source: True, _load_folder),
}
LAYOUTS = tuple(Layout(name, *readers, **TOLD[name]) for name, readers in _READERS.items())
"""The first that a source looks like is its own; a plain folder fits everything."""


def layout_named(name: str) -> Layout:
    """The layout of that name; an unknown name is an error with a suggestion."""
    by_name = {layout.name: layout for layout in LAYOUTS}
    require_known("data set", name.lower(), tuple(by_name))
    return by_name[name.lower()]
