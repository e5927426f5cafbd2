"""How data sets lie: the list of layouts, most particular first, a row each in the file that reads them.

A table that somebody laid beside images comes first: it says what they are.
"""

from derender.data.layouts.cars import SHAPENET_CARS
from derender.data.layouts.celeba import CELEBA
from derender.data.layouts.celebamask import CELEBAMASK
from derender.data.layouts.depth_pairs import DEPTH_PAIRS
from derender.data.layouts.faces import LFW, RAFDB, UTKFACE
from derender.data.layouts.folders import CLASSES, FOLDER
from derender.data.layouts.layout import Layout
from derender.data.layouts.rendered import SYNCAR, SYNFACE
from derender.data.layouts.tables import TABLE
from derender.data.layouts.tracks import FACE_TRACKS, SYNFACE_TRACKS
from derender.data.names import suggestion
from derender.data.source import Source

LAYOUTS: tuple[Layout, ...] = (
    TABLE,
    SYNCAR,
    SYNFACE,
    SYNFACE_TRACKS,
    DEPTH_PAIRS,
    RAFDB,
    CELEBAMASK,
    CELEBA,
    UTKFACE,
    LFW,
    SHAPENET_CARS,
    FACE_TRACKS,
    CLASSES,
    FOLDER,
)


def layout_named(name: str) -> Layout:
    """The layout of that name; an unknown name is an error with a suggestion."""
    for layout in LAYOUTS:
        if layout.name == name.lower():
            return layout
    known = [layout.name for layout in LAYOUTS]
    raise ValueError(f"unknown data set {name!r}{suggestion(name, known)} (known: auto, {', '.join(known)})")


def recognise(source: Source) -> Layout:
    """The first layout that the source looks like; a plain folder fits everything."""
    return next(layout for layout in LAYOUTS if layout.recognise(source))
