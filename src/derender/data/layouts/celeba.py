"""CelebA, aligned or in the wild, and CelebAMask-HQ; docs/reference/data-sets.md describes their files.

Lists are read as the owners publish them and as their CSV copies. Images in the wild get a square box about
each face, from a list of the user's own or from the landmarks. The latter is the box of CelebA-HQ without its
rotation (Karras et al., Progressive Growing of GANs, 2018, appendix C). E is the eyes' middle, e their
distance, M the middle of the mouth's corners, m = |E - M|. The side is max(4 e, 3.6 m), the middle E + 0.1 (E
- M).

Masks come in parts as published, or merged. The owners' own script for the official partition compares a
count from zero with CelebA's numbers, which start at one. Here an image is in the part in which CelebA has
it.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from derender.data.layouts.layout import (
    MOSTLY,
    TOLD,
    Labels,
    Table,
    base_name,
    header_of,
    parent_name,
    read_csv,
    read_list,
    stem_of,
    text_column,
)
from derender.data.source import Source

MASK_CLASSES = (
    *("background", "skin", "nose", "eye_g", "l_eye", "r_eye", "l_brow", "r_brow", "l_ear", "r_ear"),
    *("mouth", "u_lip", "l_lip", "hair", "hat", "ear_r", "neck_l", "neck", "cloth"),
)
"""The owners' names in their order, which is the class number: eye_g are glasses, ear_r earrings, neck_l a
necklace."""

BOX_LIST = "boxes.csv"

_PARTITIONS = {"0": "train", "1": "validation", "2": "test"}
_IN_ORDER = np.array(["", *_PARTITIONS.values()])  # the parts are runs of image numbers, from these on
_FIRST_NUMBERS = (1, 162_771, 182_638)
_EYES_AND_MOUTH = [
    f"{side}{part}_{axis}" for part in ("eye", "mouth") for side in ("left", "right") for axis in "xy"
]
_SIZED, _SIDES = ("left", "top", "width", "height"), ("left", "top", "right", "bottom")
_MAPPING = "CelebA-HQ-to-CelebA-mapping.txt"


class _OwnersList(NamedTuple):
    where: str  # its file and place
    columns: Sequence[str]  # names of its values; none where it has no such line
    rows: Mapping[str, Sequence[str]]  # by image

    def numbers(self, columns: Sequence[str], names: Sequence[str]) -> Float32[np.ndarray, "n c"]:
        """These columns for the images of these names, NaN for one without a row."""
        missing = [column for column in columns if column not in self.columns]
        if missing:
            known = ", ".join(self.columns) or "unnamed"
            raise ValueError(f"{self.where} has no column {missing[0]!r}; its columns are {known}")
        places = [self.columns.index(column) for column in columns]
        unknown = ["nan"] * len(self.columns)
        try:
            rows = [[float(self.rows.get(name, unknown)[place]) for place in places] for name in names]
        except ValueError as problem:
            raise ValueError(f"{self.where} holds something that is no number ({problem})") from problem
        return np.array(rows, np.float32).reshape(len(names), len(columns))


def _owners_list(
    source: Source, stem: str, codes: Sequence[str] = (), meaning: str = ""
) -> _OwnersList | None:
    """The list of that name, as the original text or as a CSV copy, or None when neither is there."""
    file = source.named(f"{stem}.txt", f"{stem}.csv")
    if file is None:
        return None
    where = f"{file} in {source.path}"
    comma = "," if file.endswith(".csv") else None
    lines = [line.strip() for line in source.read_text(file).split("\n")]
    counted = comma is None and lines[0].isdecimal()
    head = 2 if counted else 1 if comma else 0
    if len(lines) <= head or not lines[head]:
        raise ValueError(f"{where} is cut short: expected rows below the names of its columns")
    columns = lines[head - 1].split(comma) if head else []
    if columns and (comma or columns[0] == "image_id"):
        columns = columns[1:]
    rows, count = {}, len(columns) or 1
    for number, line in enumerate(lines[head:], head + 1):
        name, *values = line.split(comma) or [""]
        if line and (len(values) != count or (codes and not set(values) <= set(codes))):
            expected = f"a name and {count} values{meaning}"
            raise ValueError(f"{where}, line {number}: expected {expected}, got {line[:80]!r}")
        if line:
            rows[name] = values
    if counted and len(rows) < int(lines[0]):
        raise ValueError(
            f"{where} is cut short: its first line says {int(lines[0]):,} rows and it has "
            f"{len(rows):,}; copy it again, or correct that line"
        )
    return _OwnersList(where, columns, rows)


def _attributes(source: Source, stem: str, names: Sequence[str]) -> Labels:
    """Every attribute as 1 yes, 0 no, -1 unknown (no row) for these images; none without the list."""
    listed = _owners_list(source, stem, ("-1", "0", "1"), " of -1 or 1")
    if listed is None:
        return {}
    rows = {name: np.array([value == "1" for value in row], np.int8) for name, row in listed.rows.items()}
    unknown = np.full(len(listed.columns), -1, np.int8)
    values = np.array([rows.get(name, unknown) for name in names], np.int8).reshape(len(names), -1)
    return {column: values[:, place].copy() for place, column in enumerate(listed.columns)}


def is_celeba(source: Source) -> bool:
    return source.named("list_attr_celeba.txt", "list_attr_celeba.csv") is not None


def load_celeba(source: Source) -> Table | None:
    """Attributes, and identity and the official partition where their lists are there; boxes in the wild."""
    if not is_celeba(source) or not source.images:
        return None
    aligned, wild = (
        tuple(file for file in source.images if folder in file.split("/")[:-1])
        for folder in ("img_align_celeba", "img_celeba")
    )
    files = aligned or wild or source.images
    names = [base_name(file) for file in files]
    labels, partition = _attributes(source, "list_attr_celeba", names), None
    if (listed := _owners_list(source, "identity_CelebA")) is not None:
        labels["identity"] = text_column(listed.rows.get(name, [""])[0] for name in names)
    meaning = " of 0 (train), 1 (validation) or 2 (test)"
    if (listed := _owners_list(source, "list_eval_partition", tuple(_PARTITIONS), meaning)) is not None:
        partition = text_column(_PARTITIONS.get(listed.rows.get(name, [""])[0], "") for name in names)
    boxes = _face_boxes(source, names) if wild and not aligned else None
    return Table(files, labels, partition, boxes)


def _face_boxes(source: Source, names: Sequence[str]) -> Float32[np.ndarray, "n 4"]:
    """A box about each face in the wild (left, top, right, bottom); NaN for an image without landmarks."""
    own, landmarks = source.named(BOX_LIST), _owners_list(source, "list_landmarks_celeba")
    if own is not None:
        return _own_boxes(source, own, names)
    if landmarks is None:
        raise ValueError(
            f"{source.path} holds CelebA's images in the wild (img_celeba), but no "
            "list_landmarks_celeba.txt, which says where faces are. "
            f"The owners publish it at {TOLD['celeba']['home']}. "
            f"A list of your own may stand in for it: {BOX_LIST}, with rows of file,{','.join(_SIZED)}"
        )
    points = landmarks.numbers(_EYES_AND_MOUTH, names).reshape(-1, 4, 2)
    eyes, mouth = points[:, :2].mean(axis=1), points[:, 2:].mean(axis=1)
    apart = np.linalg.norm(points[:, 1] - points[:, 0], axis=1)
    down = np.linalg.norm(eyes - mouth, axis=1)
    middle, half = eyes + 0.1 * (eyes - mouth), np.maximum(4 * apart, 3.6 * down)[:, None] / 2
    return np.concatenate([middle - half, middle + half], axis=1).astype(np.float32)


def _own_boxes(source: Source, file: str, names: Sequence[str]) -> Float32[np.ndarray, "n 4"]:
    """The boxes of a list that the user made; an image without a row or with an empty box is an error."""
    columns = _SIZED if "width" in header_of(source, file) else _SIDES
    rows = read_csv(source, file, ("file", *columns))
    listed = _OwnersList(
        f"{file} in {source.path}",
        columns,
        {base_name(row["file"]): [row[c] for c in columns] for row in rows},
    )
    if missing := [name for name in names if name not in listed.rows]:
        raise ValueError(
            f"{listed.where} has no row for {missing[0]} ({len(missing):,} of {len(names):,} images have "
            "none): add the rows, or move these images or the list out of the folder"
        )
    boxes = listed.numbers(columns, names)
    if columns == _SIZED:
        boxes[:, 2:] += boxes[:, :2]
    if not (has_area := (boxes[:, 2:] > boxes[:, :2]).all(axis=1)).all():
        raise ValueError(f"{listed.where}: the box of {names[int(has_area.argmin())]} has no area")
    return boxes


def parts_of(source: Source) -> dict[str, dict[int, str]]:
    """The files of every mask in parts, by class number, under the mask's name (FOLDER/NUMBER_*.png)."""
    numbers = {name: number for number, name in enumerate(MASK_CLASSES) if number}
    result: dict[str, dict[int, str]] = {}
    for file in source.files:
        if file.endswith(".png"):
            folder, _, name = file.rpartition("/")
            digits, _, part = name.removesuffix(".png").partition("_")
            if part in numbers and digits.isdecimal():
                result.setdefault(f"{folder}/{digits}_*.png", {})[numbers[part]] = file
    return result


def _mask_images(source: Source) -> tuple[str, ...]:
    published = tuple(file for file in source.images if parent_name(file) == "CelebA-HQ-img")
    return published or tuple(file for file in source.images if parent_name(file) == "images")


def _mask_names(source: Source, images: Sequence[str]) -> list[str]:
    """The mask of each image, "" where there is none: a file, or FOLDER/NUMBER_*.png for one in parts."""
    merged = {file for file in source.files if file.endswith(".png") and parent_name(file) == "masks"}
    in_parts = {int(base_name(name).removesuffix("_*.png")): name for name in parts_of(source)}
    names = []
    for file in images:
        stem, folders = stem_of(file), file.split("/")[:-2]
        number = int(stem) if stem.isdecimal() and stem.isascii() else -1
        beside = "/".join([*folders, "masks", f"{stem}.png"])
        names.append(beside if beside in merged else in_parts.get(number, ""))
    return names


def is_celebamask(source: Source) -> bool:
    files = _mask_images(source)
    return bool(files) and sum(map(bool, _mask_names(source, files))) >= MOSTLY * len(files)


def load_celebamask(source: Source) -> Table | None:
    """The label ``mask`` names each mask ("" for none); attributes and parts where their lists are there."""
    files = _mask_images(source)
    masks = _mask_names(source, files)
    if not any(masks):
        return None
    names = [base_name(file) for file in files]
    labels, partition = _attributes(source, "CelebAMask-HQ-attribute-anno", names), None
    if (mapping := source.named(_MAPPING)) is not None:
        expected, header = "idx orig_idx orig_file, as in 0 119613 119614.jpg", r"idx\s+orig_idx\s+orig_file"
        rows = read_list(source, mapping, r"(\d+)\s+\S+\s+(\d+)(?:\.\w+)?", expected, header)
        origins = {f"{int(number)}.jpg": int(origin) for _, (number, origin) in rows}
        numbers = [origins.get(name, 0) for name in names]
        partition = _IN_ORDER[np.searchsorted(_FIRST_NUMBERS, numbers, "right")]
    return Table(files, {"mask": text_column(masks), **labels}, partition)
