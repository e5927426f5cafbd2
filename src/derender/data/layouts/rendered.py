"""Rendered collections, whose params.csv gives the exact factors of every image: synface and syncar.

Angles become radians here. Light and camera columns are in the canonical frame (docs/conventions.md). The
maps of depth, normals, albedo and mask are read by data/ground_truth.py.
"""

import math
from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np

from derender.data.layouts.layout import (
    Labels,
    Layout,
    Table,
    header_of,
    number_column,
    one_of,
    parent_name,
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


def subsets_of(source: Source) -> dict[str, str]:
    """Folder of each params.csv that has an images folder beside it, by the folder's name ("" at the top)."""
    if source.named("params.csv") is None:
        return {}
    tables = [PurePosixPath(file) for file in source.files if f"/{file}".endswith("/params.csv")]
    depicted = {PurePosixPath(file).parent.parent for file in source.files if parent_name(file) == "images"}
    folders = [table.parent for table in tables if table.parent in depicted]
    return {folder.name: "" if str(folder) == "." else f"{folder}/" for folder in folders}


def subset_folder(source: Source, subset: str | None, default: str = "train") -> str:
    """The folder (with a final slash, or "") of a subset: the one named, the default or the only one."""
    subsets = subsets_of(source)
    if not subsets:
        raise ValueError(
            f"{source.path} has no params.csv with an images folder beside it, as rendered sets have"
        )
    return subsets[one_of(source, subset, default, subsets)]


def parameters_of(source: Source, table: str, files: Sequence[str]) -> tuple[Labels, int]:
    """The known columns of a params.csv for some images, in our units; and how many have a row there."""
    folder = table.removesuffix("params.csv")
    by_file = {folder + row["file"]: row for row in read_csv(source, table, ("file",))}
    columns = next(iter(by_file.values()), {})
    rows = [by_file.get(file) or dict.fromkeys(columns, "") for file in files]
    labels: Labels = {name: text_column(row[name] for row in rows) for name in _TEXTS if name in columns}
    for name, (label, factor) in _NUMBERS.items():
        if name in columns:
            try:
                values = np.array([float(row[name] or "nan") for row in rows])
            except ValueError as problem:
                raise ValueError(
                    f"{table} in {source.path}: column {name!r} holds something that is no number ({problem})"
                ) from problem
            labels[label] = number_column(values * factor)
    return labels, sum(file in by_file for file in files)


def _read_rendered(source: Source, subset: str | None) -> Table:
    folder = subset_folder(source, subset)
    table = f"{folder}params.csv"
    files = tuple(file for file in source.images if file.startswith(f"{folder}images/"))
    labels, known = parameters_of(source, table, files)
    if files and not known:
        raise ValueError(f"{table} in {source.path} names none of the images in {folder}images")
    masks = [f"{folder}masks/{PurePosixPath(file).stem}.png" for file in files]
    if masks and set(masks) <= set(source.files):
        labels["mask"] = text_column(masks)  # numbers of parts, for read_masks
    name = parent_name(table)
    return Table(files, labels, text_column([name] * len(files)) if name else None)


def _columns(source: Source) -> list[str]:
    """The columns of the first subset's params.csv, none without any subset."""
    folder = next(iter(subsets_of(source).values()), None)
    return [] if folder is None else header_of(source, f"{folder}params.csv")


SYNCAR = Layout(
    "syncar",
    "rendered cars with exact factors",
    "",
    lambda source: "class" in _columns(source),
    _read_rendered,
)
SYNFACE = Layout(
    "synface",
    "rendered faces with exact factors",
    "",
    lambda source: "file" in (columns := _columns(source)) and "class" not in columns,
    _read_rendered,
)
