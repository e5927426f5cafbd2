"""Rendered collections, whose params.csv gives the exact factors of every picture: synface, syncar,
synface_tracks.

Angles become radians here. Light and camera columns are in the canonical frame (docs/conventions.md). The
maps of depth, normals, albedo and mask are read by data/ground_truth.py.
"""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath

import numpy as np

from derender.data.layout import (
    Labels,
    Layout,
    Table,
    header_of,
    number_column,
    pictures_of,
    read_csv,
    text_column,
)
from derender.data.source import Source

# column in params.csv: (label, factor to our unit)
_NUMBERS = {
    "strength": ("strength", 1.0),
    "age": ("age", 1.0),
    "skin_tone": ("skin_tone", 1.0),
    "ambient": ("ambient", 1.0),
    "diffuse": ("diffuse", 1.0),
    "light_pitch": ("light_pitch_rad", math.pi / 180),
    "light_yaw": ("light_yaw_rad", math.pi / 180),
    "pitch": ("camera_x_rad", math.pi / 180),
    "yaw": ("camera_y_rad", math.pi / 180),
    "roll": ("camera_z_rad", math.pi / 180),
    "tx": ("camera_tx", 1.0),
    "ty": ("camera_ty", 1.0),
    "elev": ("elevation_rad", math.pi / 180),
    "azim": ("azimuth_rad", math.pi / 180),
}
_TEXTS = (
    *("identity", "expression", "class", "model", "track", "frame", "light_kind"),
    *("hair", "hair_colour", "beard", "style"),
)
LIGHT = ("ambient", "diffuse", "light_pitch_rad", "light_yaw_rad")
CAMERA = ("camera_x_rad", "camera_y_rad", "camera_z_rad", "camera_tx", "camera_ty")

_TRACK = re.compile(r"(?:.*/)?tracks/(?P<identity>[^/]+)/(?P<track>[^/]+)/(?P<frame>[^/]+)\.\w+")


def subsets_of(source: Source) -> dict[str, str]:
    """Folder of each params.csv that has an images folder beside it, by the folder's name ("" at the top)."""
    if source.named("params.csv") is None:
        return {}
    tables = [PurePosixPath(file) for file in source.files if f"/{file}".endswith("/params.csv")]
    pictured = {
        PurePosixPath(file).parent.parent for file in source.files if f"/{file}".rsplit("/", 2)[1] == "images"
    }
    folders = [table.parent for table in tables if table.parent in pictured]
    return {folder.name: "" if str(folder) == "." else f"{folder}/" for folder in folders}


def subset_folder(source: Source, subset: str | None) -> str:
    """The folder (with a final slash, or "") of a subset; by default ``train``, or the only one there is."""
    subsets = subsets_of(source)
    if not subsets:
        raise ValueError(
            f"{source.path} has no params.csv with an images folder beside it, as rendered sets have"
        )
    if subset is None:
        subset = "train" if "train" in subsets else next(iter(subsets)) if len(subsets) == 1 else None
    if subset not in subsets:
        asked = "name one of its subsets" if subset is None else f"it has no subset {subset!r}"
        raise ValueError(f"{source.path}: {asked}; there are {', '.join(repr(name) for name in subsets)}")
    return subsets[subset]


def parameters_of(rows: Sequence[Mapping[str, str]], where: str) -> Labels:
    """The known columns of params.csv as labels: text as it is, numbers in our units."""
    columns = rows[0] if rows else {}
    labels: Labels = {name: text_column(row[name] for row in rows) for name in _TEXTS if name in columns}
    for name, (label, factor) in _NUMBERS.items():
        if name in columns:
            try:
                values = np.array([float(row[name] or "nan") for row in rows])
            except ValueError as problem:
                raise ValueError(
                    f"{where}: column {name!r} holds something that is no number ({problem})"
                ) from problem
            labels[label] = number_column(values * factor)
    return labels


def _read_rendered(source: Source, subset: str | None) -> Table:
    folder = subset_folder(source, subset)
    rows = read_csv(source, f"{folder}params.csv", ("file",))
    by_file = {folder + row["file"]: row for row in rows}
    files = tuple(file for file in source.pictures if file.startswith(f"{folder}images/"))
    known = [file for file in files if file in by_file]
    if files and not known:
        raise ValueError(f"{folder}params.csv in {source.path} names none of the pictures in {folder}images")
    empty = dict.fromkeys(rows[0], "") if rows else {}
    labels = parameters_of(
        [by_file.get(file, empty) for file in files], f"{folder}params.csv in {source.path}"
    )
    masks = [f"{folder}masks/{PurePosixPath(file).stem}.png" for file in files]
    if masks and set(masks) <= set(source.files):
        labels["mask"] = text_column(masks)  # numbers of parts, for read_masks
    name = folder.rstrip("/").rpartition("/")[2]
    return Table(files, labels, text_column([name] * len(files)) if name else None)


def _has_column(source: Source, column: str) -> bool | None:
    """Whether the first subset's params.csv has the column; None without any subset."""
    folder = next(iter(subsets_of(source).values()), None)
    return None if folder is None else column in header_of(source, f"{folder}params.csv")


def _is_syncar(source: Source) -> bool:
    return _has_column(source, "class") is True


def _is_synface(source: Source) -> bool:
    return _has_column(source, "file") is True and not _is_syncar(source)


def _is_tracks(source: Source) -> bool:
    return bool(source.pictures) and all(_TRACK.fullmatch(file) for file in source.pictures)


def _read_tracks(source: Source, subset: str | None) -> Table:
    """Identity and track from the folders (a track's label is IDENTITY/TRACK), the rest from params.csv."""
    files = pictures_of(source, subset)
    found = [_TRACK.fullmatch(file) for file in files]
    stray = next((file for file, match in zip(files, found, strict=True) if match is None), None)
    if stray is not None:
        raise ValueError(f"{source.path} is no set of tracks: {stray} does not lie in tracks/IDENTITY/TRACK/")
    matches = [match for match in found if match is not None]
    labels: Labels = {}
    table = source.named("params.csv")
    if table is not None:
        folder = table.removesuffix("params.csv")
        by_file = {folder + row["file"]: row for row in read_csv(source, table, ("file",))}
        empty = dict.fromkeys(next(iter(by_file.values())), "") if by_file else {}
        labels = parameters_of([by_file.get(file, empty) for file in files], f"{table} in {source.path}")
    labels["identity"] = text_column(match["identity"] for match in matches)
    labels["track"] = text_column(f"{match['identity']}/{match['track']}" for match in matches)
    labels["frame"] = text_column(match["frame"] for match in matches)
    return Table(files, labels)


RENDERED = (
    Layout("syncar", "rendered cars with exact factors", "", _is_syncar, _read_rendered),
    Layout("synface", "rendered faces with exact factors", "", _is_synface, _read_rendered),
    Layout("synface_tracks", "tracks: tracks/IDENTITY/TRACK/FRAME", "", _is_tracks, _read_tracks),
)
