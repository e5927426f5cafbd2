"""The list of layouts, most particular first. A new data set is one more row in the file of its kind."""

from derender.data.faces import FACES
from derender.data.folders import FOLDERS
from derender.data.layout import Layout
from derender.data.nearest import nearest
from derender.data.rendered import RENDERED
from derender.data.source import Source

LAYOUTS: tuple[Layout, ...] = (*RENDERED, *FACES, *FOLDERS)


def layout_named(name: str) -> Layout:
    """The layout of that name; an unknown name is an error that names the nearest."""
    for layout in LAYOUTS:
        if layout.name == name.lower():
            return layout
    known = [layout.name for layout in LAYOUTS]
    raise ValueError(f"unknown data set {name!r}{nearest(name, known)} (known: auto, {', '.join(known)})")


def recognise(source: Source) -> Layout:
    """The first layout that the source looks like; a plain folder fits everything."""
    return next(layout for layout in LAYOUTS if layout.recognise(source))
