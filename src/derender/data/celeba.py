"""CelebA: 202,599 faces of 10,177 people with 40 attributes, aligned or in the wild.

Lists are read as the owners publish them (``list_attr_celeba.txt``: a count, the columns, a row for each
picture; ``identity_CelebA.txt`` and ``list_eval_partition.txt``: rows only) and as their CSV copies. Only
the attributes must be there. Aligned pictures (``img_align_celeba``, 178 x 218) are used whole. Pictures
in the wild (``img_celeba``, any size) show a scene with a face in it, so each gets a square box about its
face:

- from a list of the user's own (data/box_list.py), those boxes as they are;
- else from ``list_landmarks_celeba.txt``, the box of CelebA-HQ without its rotation (Karras et al.,
  Progressive Growing of GANs, 2018, appendix C): with the eyes' middle E, their distance e, the middle of
  the mouth's corners M and m = |E - M|, the side is max(4 e, 3.6 m) and the middle E + 0.1 (E - M);
- else from ``list_bbox_celeba.txt``, the square about the middle of the owners' box whose side is the
  box's longer one.

unsup3d was trained on its own crops of the pictures in the wild. It publishes those boxes as a list, and
not the rule behind them (github.com/elliottwu/unsup3d, issue 30): without that list in the folder the boxes
resemble its crops and are not the same.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np
from jaxtyping import Float32

from derender.data.box_list import BOX_LISTS, read_box_list
from derender.data.layout import Labels, Layout, Table, part_of, text_column
from derender.data.source import Source

HOME = "https://mmlab.ie.cuhk.edu.hk/projects/CelebA.html"
PARTITIONS = {"0": "train", "1": "validation", "2": "test"}

_EYES_AND_MOUTH = (
    *("lefteye_x", "lefteye_y", "righteye_x", "righteye_y"),
    *("leftmouth_x", "leftmouth_y", "rightmouth_x", "rightmouth_y"),
)
_BOX = ("x_1", "y_1", "width", "height")


@dataclass(frozen=True)
class Listing:
    """One of the owners' lists.

    Attributes:
        file: its name in the source.
        columns: what the values of a row are; empty where the list does not say.
        rows: the values by picture name.
        first_line: the number of the first row's line, for messages.
    """

    file: str
    columns: tuple[str, ...]
    rows: dict[str, list[str]]
    first_line: int

    def line_of(self, name: str) -> int:
        return self.first_line + list(self.rows).index(name)


def read_listing(source: Source, stem: str) -> Listing | None:
    """The list of that name, as the original text or as a CSV copy, or None when neither is there.

    A row of another length than the others, and a list with fewer rows than its first line says, are errors.
    """
    file = source.named(f"{stem}.txt") or source.named(f"{stem}.csv")
    if file is None:
        return None
    comma = "," if file.endswith(".csv") else None
    lines = [line.strip() for line in source.read_text(file).split("\n")]
    counted = comma is None and lines[0].isdecimal()
    head = 2 if counted else 1 if comma else 0
    if len(lines) <= head or not lines[head]:
        raise ValueError(
            f"{file} in {source.path} is cut short: expected rows below the names of its columns"
        )
    columns = lines[head - 1].split(comma) if head else []
    if columns and (comma or columns[0] == "image_id"):
        columns = columns[1:]
    rows = {}
    for number, line in enumerate(lines[head:], head + 1):
        name, *values = line.split(comma) if line else [""]
        if line and len(values) != (len(columns) or 1):
            raise ValueError(
                f"{file} in {source.path}, line {number}: expected a name and {len(columns) or 1} values"
                + (" of -1 or 1" if "attr" in stem else "")
            )
        if line:
            rows[name] = values
    if counted and len(rows) < int(lines[0]):
        raise ValueError(
            f"{file} in {source.path} is cut short: its first line says {int(lines[0]):,} rows and it has "
            f"{len(rows):,}; copy it again, or correct that line"
        )
    return Listing(file, tuple(columns), rows, head + 1)


def attribute_labels(source: Source, listing: Listing, names: Sequence[str]) -> Labels:
    """Every attribute as 1 yes, 0 no, -1 unknown (no row) for the pictures of these names."""
    rows = {}
    for name, values in listing.rows.items():
        if not set(values) <= {"-1", "0", "1"}:
            raise ValueError(
                f"{listing.file} in {source.path}, line {listing.line_of(name)}: expected a name and "
                f"{len(listing.columns)} values of -1 or 1"
            )
        rows[name] = np.array([value == "1" for value in values], np.int8)
    unknown = np.full(len(listing.columns), -1, np.int8)
    values = np.array([rows.get(name, unknown) for name in names], np.int8).reshape(len(names), -1)
    return {column: values[:, place].copy() for place, column in enumerate(listing.columns)}


def partition_of(source: Source, names: Sequence[str]) -> np.ndarray | None:
    """The official part of each picture of CelebA, "" where it has no row; None without the list."""
    listing = read_listing(source, "list_eval_partition")
    if listing is None:
        return None
    wrong = next((name for name, (code,) in listing.rows.items() if code not in PARTITIONS), None)
    if wrong is not None:
        raise ValueError(
            f"{listing.file} in {source.path}, line {listing.line_of(wrong)}: a part is 0 (train), "
            f"1 (validation) or 2 (test), got {listing.rows[wrong][0]!r}"
        )
    return text_column(PARTITIONS[listing.rows[name][0]] if name in listing.rows else "" for name in names)


def _is_celeba(source: Source) -> bool:
    return (
        source.named("list_attr_celeba.txt") is not None or source.named("list_attr_celeba.csv") is not None
    )


def _read_celeba(source: Source, subset: str | None) -> Table:
    """Attributes, and identity and the official partition where their lists are there; boxes in the wild."""
    attributes = read_listing(source, "list_attr_celeba")
    if attributes is None:
        raise ValueError(f"{source.path} has no list_attr_celeba.txt; CelebA's owners publish it at {HOME}")
    files, in_the_wild = _pictures(source)
    names = [PurePosixPath(file).name for file in files]
    labels = attribute_labels(source, attributes, names)
    identities = read_listing(source, "identity_CelebA")
    if identities is not None:
        labels["identity"] = text_column(identities.rows.get(name, [""])[0] for name in names)
    boxes = _face_boxes(source, files, names) if in_the_wild else None
    table = Table(files, labels, partition_of(source, names), boxes)
    return part_of(table, source, subset, "list_eval_partition.txt")


def _pictures(source: Source) -> tuple[tuple[str, ...], bool]:
    """Aligned pictures if there are any, else those in the wild, else all; and whether they are wild."""
    for folder in ("img_align_celeba", "img_celeba"):
        files = tuple(file for file in source.pictures if folder in PurePosixPath(file).parts[:-1])
        if files:
            return files, folder == "img_celeba"
    if not source.pictures:
        raise ValueError(
            f"{source.path} has CelebA's list of attributes and no pictures: expected img_align_celeba or "
            f"img_celeba, unpacked; CelebA's owners publish both at {HOME}"
        )
    return source.pictures, False


def _face_boxes(source: Source, files: Sequence[str], names: Sequence[str]) -> Float32[np.ndarray, "n 4"]:
    """A box about each face in the wild (left, top, right, bottom); NaN for a picture without a row."""
    own = read_box_list(source, files)
    if own is not None:
        return own
    for stem, columns, square in (
        ("list_landmarks_celeba", _EYES_AND_MOUTH, _square_of_landmarks),
        ("list_bbox_celeba", _BOX, _square_of_box),
    ):
        listing = read_listing(source, stem)
        if listing is not None:
            return square(_numbers(source, listing, columns, names))
    raise ValueError(
        f"{source.path} holds CelebA's pictures in the wild (img_celeba), which are cropped to their "
        f"face, but neither list_landmarks_celeba.txt nor list_bbox_celeba.txt; the owners publish both "
        f"at {HOME}. A list of your own may stand in for them: {BOX_LISTS[0]}, with rows of "
        f"file,left,top,width,height"
    )


def _numbers(
    source: Source, listing: Listing, columns: Sequence[str], names: Sequence[str]
) -> Float32[np.ndarray, "n c"]:
    missing = [column for column in columns if column not in listing.columns]
    if missing:
        raise ValueError(
            f"{listing.file} in {source.path} has no column {missing[0]!r}; "
            f"its columns are {', '.join(listing.columns) or 'unnamed'}"
        )
    places = [listing.columns.index(column) for column in columns]
    unknown = ["nan"] * len(listing.columns)
    try:
        rows = [[float(listing.rows.get(name, unknown)[place]) for place in places] for name in names]
    except ValueError as problem:
        raise ValueError(
            f"{listing.file} in {source.path} holds something that is no number ({problem})"
        ) from problem
    return np.array(rows, np.float32).reshape(len(names), len(columns))


def _square_of_landmarks(points: Float32[np.ndarray, "n 8"]) -> Float32[np.ndarray, "n 4"]:
    left_eye, right_eye, left_mouth, right_mouth = (points[:, at : at + 2] for at in (0, 2, 4, 6))
    eyes, mouth = (left_eye + right_eye) / 2, (left_mouth + right_mouth) / 2
    apart = np.linalg.norm(right_eye - left_eye, axis=1)
    down = np.linalg.norm(eyes - mouth, axis=1)
    return _square(eyes + 0.1 * (eyes - mouth), np.maximum(4 * apart, 3.6 * down))


def _square_of_box(box: Float32[np.ndarray, "n 4"]) -> Float32[np.ndarray, "n 4"]:
    return _square(box[:, :2] + box[:, 2:] / 2, box[:, 2:].max(axis=1))


def _square(
    middle: Float32[np.ndarray, "n 2"], side: Float32[np.ndarray, " n"]
) -> Float32[np.ndarray, "n 4"]:
    half = side[:, None] / 2
    return np.concatenate([middle - half, middle + half], axis=1).astype(np.float32)


CELEBA = Layout(
    "celeba",
    "CelebA: faces with 40 attributes",
    HOME,
    _is_celeba,
    _read_celeba,
    "non-commercial research only",
)
