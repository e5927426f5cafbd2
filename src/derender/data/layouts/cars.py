"""ShapeNet's cars, rendered: folders train, val and test of images whose paths hold the model's id.

unsup3d released the paper's images (github.com/elliottwu/unsup3d, issue 18). Those of 128 x 128 are cropped
to rows 8 to 108 and columns 14 to 114. We could not see the archive itself: a model's id is taken to be 24 to
32 hexadecimal digits in the path. Images named by such digits may be anything, so the layout is recognised
only beside ShapeNet's table or below a folder 02958343, the number of its cars; else ask for it by name. That
table (``02958343.csv`` or ``metadata.csv``) gives names, and by words in them the label ``class``, one of
five or "". The paper's fifth is Ferrari, which is among its words here.
"""

import re

import numpy as np

from derender.data.image import DECODER_ERRORS, upright_size
from derender.data.layouts.layout import (
    MOSTLY,
    Labels,
    Layout,
    Table,
    header_of,
    partition_by_folder,
    partition_column,
    read_csv,
    text_column,
)
from derender.data.source import Source

HOME = "https://github.com/elliottwu/unsup3d"

CAR_CLASSES = {
    "police": ("police", "patrol car", "squad car", "prowl car"),
    "ambulance": ("ambulance",),
    "limousine": ("limousine", "limo"),
    "jeep": ("jeep",),
    "sports": ("sports car", "sport car", "sportscar", "ferrari"),
}
"""The words by which a car belongs to one of the paper's five classes; the first class that fits is taken."""

_ID = re.compile(r"(?<![0-9a-f])[0-9a-f]{24,32}(?![0-9a-f])")
_CARS = "02958343"
_PUBLISHED_SIZE = (128, 128)
_CROP = (14, 8, 114, 108)  # left, top, right, bottom
_MAPS = {"depth", "mask", "normal", "albedo"}  # folders of maps beside images, as unsup3d's faces have
_TABLES = (f"{_CARS}.csv", "metadata.csv", "all.csv")


def _table_of(source: Source) -> str | None:
    """ShapeNet's table, recognised by its columns, or None."""
    candidates = [file for name in _TABLES if (file := source.named(name)) is not None]
    return next((file for file in candidates if "fullId" in header_of(source, file)), None)


def _is_cars(source: Source) -> bool:
    files = source.images
    ours = _table_of(source) is not None or any(_CARS in file.split("/") for file in files[:1])
    return ours and bool(files) and sum(1 for file in files if _ID.search(file)) >= MOSTLY * len(files)


def _load_cars(source: Source) -> Table:
    files = tuple(file for file in source.images if not _MAPS & set(file.split("/")[:-1]))
    models = [found[0] if (found := _ID.search(file)) else "" for file in files]
    partition = partition_column(map(partition_by_folder, files))
    if not any(models) and partition is None:
        raise ValueError(
            f"{source.path} holds no rendered ShapeNet cars: expected folders train, val and test, "
            f"or ids in the names (1a2b3c4d5e6f708192a3b4c5d6e7f809_000.png); unsup3d publishes its own by "
            f"way of {HOME}"
        )
    labels: Labels = {"model": text_column(models)} if any(models) else {}
    if (table := _table_of(source)) is not None:
        known = {
            row["fullId"].rpartition(".")[2]: (
                row["name"],
                car_class(row["name"], row["tags"], row["wnlemmas"]),
            )
            for row in read_csv(source, table, ("fullId", "wnlemmas", "name", "tags"))
        }
        if not known.keys() & set(models):
            raise ValueError(
                f"{table} in {source.path} names none of the models there; ShapeNet's owners publish "
                f"the table of cars ({_CARS}) at https://shapenet.org"
            )
        found = [known.get(model, ("", "")) for model in models]
        labels["name"], labels["class"] = map(text_column, zip(*found, strict=True))
    try:  # the published crop for every image if the first one has the published size
        published = bool(files) and upright_size(source.read(files[0])) == _PUBLISHED_SIZE
    except DECODER_ERRORS:
        published = False
    boxes = np.tile(np.array(_CROP, np.float32), (len(files), 1)) if published else None
    return Table(files, labels, partition, boxes)


def car_class(*texts: str) -> str:
    """The class of a car whose name, tags and the like are these: a key of ``CAR_CLASSES``, or ""."""
    text = " , ".join(texts).lower().replace("_", " ")
    for kind, words in CAR_CLASSES.items():
        if re.search(rf"\b({'|'.join(words)})s?\b", text):
            return kind
    return ""


SHAPENET_CARS = Layout(
    "shapenet_cars", "ShapeNet cars, rendered: train, val and test, model ids in the names",
    _is_cars, _load_cars, HOME,
    "models: ShapeNet's terms, non-commercial research and education only", "a folder train, val or test",
)  # fmt: skip
