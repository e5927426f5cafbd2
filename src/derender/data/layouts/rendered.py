"""Rendered collections: exact factors of every image in a params.csv, depth maps, or cars from ShapeNet.

Their files are described in docs/reference/data-sets.md. Angles become radians here; light and camera are
canonical (docs/reference/conventions.md). unsup3d released the paper's cars (github.com/elliottwu/unsup3d,
issue 18). Untested on the archive itself: a model's id is taken to be 24 to 32 hexadecimal digits in the
path. Images named by such digits may be anything. So the layout is recognised only beside ShapeNet's table or
below a folder 02958343, the number of its cars. Words in that table give the label ``class``, one of five or
"". The paper's fifth is Ferrari, which is among its words here. All maps are read by data/maps.py.
"""

import math
import re
from collections.abc import Mapping, Sequence

import numpy as np

from derender.data.image import DECODER_ERRORS, upright_size
from derender.data.layouts import layout
from derender.data.layouts.layout import Labels, Table, partition_column, read_csv, text_column
from derender.data.source import Source, parent_name, stem_of
from derender.storage.bounded import table_beside

LIGHT = ("ambient", "diffuse", "light_pitch_rad", "light_yaw_rad")
CAMERA = ("camera_x_rad", "camera_y_rad", "camera_z_rad", "camera_tx", "camera_ty")

_NUMBERS, _DEGREES, _TEXTS, CAR_CLASSES = table_beside(__file__, "rendered.yaml").values()
_TRACK = re.compile(r"(?:.*/)?tracks/(?P<identity>[^/]+)/(?P<track>[^/]+)/[^/]+\.\w+")

_ID = re.compile(r"(?<![0-9a-f])[0-9a-f]{24,32}(?![0-9a-f])")
_CARS = "02958343"
_CROP = (14, 8, 114, 108)  # of the published 128 x 128: left, top, right, bottom
_MAPS = {"depth", "mask", "normal", "albedo"}  # folders of maps beside images, as unsup3d's faces have
_TABLES = (f"{_CARS}.csv", "metadata.csv", "all.csv")


def rendered_folders(source: Source) -> list[str]:
    """The folders (with a final slash, or "") that hold a params.csv and images beside it."""
    if source.named("params.csv") is None:
        return []
    depicted = {file.rpartition("/")[0].removesuffix("images") for file in source.images_in("images")}
    tables = (file for file in source.files if f"/{file}".endswith("/params.csv"))
    return [folder for table in tables if (folder := table.removesuffix("params.csv")) in depicted]


def pairs_of(source: Source) -> dict[str, str]:
    """Image to depth map, for every image in a folder ``image`` with a map in the folder beside it."""
    images = source.images_in("image")
    known, result = set(source.files) if images else set(), {}
    for file in images:
        stem, folder = stem_of(file), file.rpartition("/")[0].removesuffix("image")
        names = (f"{folder}depth/{name}.png" for name in (stem.replace("image", "depth"), stem))
        if (name := next((name for name in names if name in known), None)) is not None:
            result[file] = name
    return result


def track_labels(files: Sequence[str], pattern: re.Pattern[str]) -> Labels | None:
    """Identity, track (unique in the whole set) and frame; None if a name does not fit the pattern."""
    matches = [match for file in files if (match := pattern.fullmatch(file))]
    if len(matches) < len(files):
        return None
    return {
        "identity": text_column(match["identity"] for match in matches),
        "track": text_column(f"{match['identity']}/{match['track']}" for match in matches),
        "frame": text_column(map(stem_of, files)),
    }


def _parameters(source: Source, folders: Sequence[str], files: Sequence[str]) -> Labels:
    """The known columns of the params.csv in these folders for some images, in our units."""
    by_file: dict[str, Mapping[str, str]] = {}
    for folder in folders:
        rows = read_csv(source, f"{folder}params.csv", ("file",))
        by_file |= {folder + row["file"]: row for row in rows}
        inside = [file for file in files if file.startswith(folder)]
        if inside and not any(file in by_file for file in inside):
            raise ValueError(f"{folder}params.csv in {source.path} names none of the images beside it")
    columns = dict.fromkeys(name for row in by_file.values() for name in row)
    rows = [by_file.get(file, {}) for file in files]
    labels = {name: text_column(row.get(name, "") for row in rows) for name in _TEXTS if name in columns}
    for name, label in (_NUMBERS | _DEGREES).items():
        if name in columns:
            try:
                values = np.array([float(row.get(name) or "nan") for row in rows])
            except ValueError as problem:
                where = f"params.csv in {source.path}: column {name!r}"
                raise ValueError(f"{where} holds something that is no number ({problem})") from problem
            labels[label] = (values * (math.pi / 180 if name in _DEGREES else 1)).astype(np.float32)
    return labels


def load_rendered(source: Source) -> Table | None:
    """The images beside every params.csv; their masks of parts, if they have such, as the label ``mask``."""
    if not (folders := rendered_folders(source)):
        return None
    beside = tuple(f"{folder}images/" for folder in folders)
    files = tuple(file for file in source.images if file.startswith(beside))
    labels = _parameters(source, folders, files)
    known = set(source.files)
    masks = [f"{file.rpartition('images/')[0]}masks/{stem_of(file)}.png" for file in files]
    if any(mask in known for mask in masks):
        labels["mask"] = text_column(mask if mask in known else "" for mask in masks)
    return Table(files, labels, partition_column(parent_name(file.rpartition("/")[0]) for file in files))


def columns(source: Source) -> list[str]:
    """The columns of the first params.csv, none without any."""
    folders = rendered_folders(source)
    return layout.header_of(source, f"{folders[0]}params.csv") if folders else []


def is_tracks(source: Source) -> bool:
    return bool(source.images) and track_labels(source.images, _TRACK) is not None


def load_tracks(source: Source) -> Table | None:
    """Identity and track from the folders, everything else from params.csv where it is there."""
    if (tracks := track_labels(source.images, _TRACK)) is None:
        return None
    table = source.named("params.csv")
    labels = {} if table is None else _parameters(source, [table.removesuffix("params.csv")], source.images)
    return Table(source.images, labels | tracks)


def is_paired(source: Source) -> bool:
    """Every image in a folder ``image`` has its depth map, and there is at least one."""
    images = source.images_in("image")
    return bool(images) and len(pairs_of(source)) == len(images)


def load_pairs(source: Source) -> Table:
    """The images without their maps, with the owners' split where the folders give one."""
    files = tuple(pairs_of(source))
    around = (file.split("/")[-3:-2] for file in files)
    return Table(files, partition=partition_column(map(layout.partition_named, around)))


def _table_of(source: Source) -> str | None:
    """ShapeNet's table, recognised by its columns, or None."""
    candidates = [file for name in _TABLES if (file := source.named(name)) is not None]
    return next((file for file in candidates if "fullId" in layout.header_of(source, file)), None)


def is_cars(source: Source) -> bool:
    ours = _table_of(source) is not None or any(_CARS in file.split("/") for file in source.images[:1])
    return ours and layout.mostly(_ID.search, source.images)


def load_cars(source: Source) -> Table | None:
    files = tuple(file for file in source.images if not _MAPS & set(file.split("/")[:-1]))
    models = [results[0] if (results := _ID.search(file)) else "" for file in files]
    partition = layout.partitions(files)
    if not any(models) and partition is None:
        return None
    labels: Labels = {"model": text_column(models)} if any(models) else {}
    if (table := _table_of(source)) is not None:
        rows = read_csv(source, table, ("fullId", "wnlemmas", "name", "tags"))
        known = {row["fullId"].rpartition(".")[2]: (row["name"], _car_class(row)) for row in rows}
        if not known.keys() & set(models):
            where = f"ShapeNet's owners publish the table of cars ({_CARS}) at https://shapenet.org"
            raise ValueError(f"{table} in {source.path} names none of the models there; {where}")
        results = [known.get(model, ("", "")) for model in models]
        labels["name"], labels["class"] = map(text_column, zip(*results, strict=True))
    try:  # the published crop for every image if the first one has the published size
        published = upright_size(source.read(files[0])) == (128, 128)
    except DECODER_ERRORS:
        published = False
    boxes = np.tile(np.array(_CROP, np.float32), (len(files), 1)) if published else None
    return Table(files, labels, partition, boxes)


def _car_class(row: Mapping[str, str]) -> str:
    """The class of a car in a row of ShapeNet's table: a key of ``CAR_CLASSES``, or ""."""
    text = " , ".join(row[name] for name in ("name", "tags", "wnlemmas")).lower().replace("_", " ")
    fits = (kind for kind, words in CAR_CLASSES.items() if re.search(rf"\b({'|'.join(words)})s?\b", text))
    return next(fits, "")
