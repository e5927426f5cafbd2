"""The list of layouts, most particular first. A new data set is one more row in the file of its kind.

A table that somebody laid beside pictures comes first: it says what they are.
"""

from derender.data.cars import SHAPENET_CARS
from derender.data.celeba import CELEBA
from derender.data.celebamask import CELEBAMASK
from derender.data.emotions import RAFDB
from derender.data.faces import FACES
from derender.data.folders import FOLDERS
from derender.data.layout import Layout
from derender.data.names import suggestion
from derender.data.paired import PAIRED
from derender.data.rendered import RENDERED
from derender.data.source import Source
from derender.data.tables import TABLE
from derender.data.tracks import FACE_TRACKS

LAYOUTS: tuple[Layout, ...] = (
    TABLE,
    *RENDERED,
    *PAIRED,
    RAFDB,
    CELEBAMASK,
    CELEBA,
    *FACES,
    SHAPENET_CARS,
    FACE_TRACKS,
    *FOLDERS,
)


def layout_named(name: str) -> Layout:
    """The layout of that name; an unknown name is an error that names the nearest."""
    for layout in LAYOUTS:
        if layout.name == name.lower():
            return layout
    known = [layout.name for layout in LAYOUTS]
    raise ValueError(f"unknown data set {name!r}{suggestion(name, known)} (known: auto, {', '.join(known)})")


def recognise(source: Source) -> Layout:
    """The first layout that the source looks like; a plain folder fits everything."""
    return next(layout for layout in LAYOUTS if layout.recognise(source))
