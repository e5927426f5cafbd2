"""CelebA: 202,599 faces of 10,177 people with 40 attributes, aligned or in the wild.

Lists are read as the owners publish them (``list_attr_celeba.txt``: a count, the columns, a row for each
image; ``identity_CelebA.txt`` and ``list_eval_partition.txt``: rows only) and as their CSV copies. Only
the attributes must be there. Aligned images (``img_align_celeba``, 178 x 218) are used whole. Images
in the wild (``img_celeba``, any size) show a scene with a face in it, so each gets a square box about its
face:

- from a list of the user's own (boxes.py), those boxes as they are;
- else from ``list_landmarks_celeba.txt``, the box of CelebA-HQ without its rotation (Karras et al.,
  Progressive Growing of GANs, 2018, appendix C): with the eyes' middle E, their distance e, the middle of
  the mouth's corners M and m = |E - M|, the side is max(4 e, 3.6 m) and the middle E + 0.1 (E - M);
- else from ``list_bbox_celeba.txt``, the square about the middle of the owners' box whose side is the
  box's longer one.

unsup3d was trained on its own crops of the images in the wild. It publishes those boxes as a list, and
not the rule behind them (github.com/elliottwu/unsup3d, issue 30): without that list in the folder the boxes
resemble its crops and are not the same.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np
from jaxtyping import Float32

from derender.data.layouts.boxes import BOX_LISTS, read_box_list
from derender.data.layouts.layout import Labels, Layout, Table, base_name, part_of, text_column
from derender.data.source import Source

HOME = "https://mmlab.ie.cuhk.edu.hk/projects/CelebA.html"
PARTITIONS = {"0": "train", "1": "validation", "2": "test"}

_EYES_AND_MOUTH = (
    *("lefteye_x", "lefteye_y", "righteye_x", "righteye_y"),
    *("leftmouth_x", "leftmouth_y", "rightmouth_x", "rightmouth_y"),
)
_BOX = ("x_1", "y_1", "width", "height")


@dataclass(frozen=True)
class OwnersList:
    """One of the owners' lists.

    Attributes:
        file: its name in the source, and where that is, for messages.
        columns: what the values of a row are; empty where the list does not say.
        rows: the values by image name.
    """

    file: str
    columns: tuple[str, ...]
    rows: dict[str, list[str]]

    def numbers(self, columns: Sequence[str], names: Sequence[str]) -> Float32[np.ndarray, "n c"]:
        """These columns for the images of these names, NaN for one without a row."""
        missing = [column for column in columns if column not in self.columns]
        if missing:
            known = ", ".join(self.columns) or "unnamed"
            raise ValueError(f"{self.file} has no column {missing[0]!r}; its columns are {known}")
        places = [self.columns.index(column) for column in columns]
        unknown = ["nan"] * len(self.columns)
        try:
            rows = [[float(self.rows.get(name, unknown)[place]) for place in places] for name in names]
        except ValueError as problem:
            raise ValueError(f"{self.file} holds something that is no number ({problem})") from problem
        return np.array(rows, np.float32).reshape(len(names), len(columns))


def read_owners_list(
    source: Source, stem: str, codes: Sequence[str] = (), meaning: str = ""
) -> OwnersList | None:
    """The list of that name, as the original text or as a CSV copy, or None when neither is there.

    A row of another length than the others or with another value than the ``codes``, and a list with fewer
    rows than its first line says, are errors.
    """
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
    rows = {}
    for number, line in enumerate(lines[head:], head + 1):
        name, *values = line.split(comma) if line else [""]
        if line and (len(values) != (len(columns) or 1) or (codes and not set(values) <= set(codes))):
            expected = f"a name and {len(columns) or 1} values{meaning}"
            raise ValueError(f"{where}, line {number}: expected {expected}, got {line[:80]!r}")
        if line:
            rows[name] = values
    if counted and len(rows) < int(lines[0]):
        raise ValueError(
            f"{where} is cut short: its first line says {int(lines[0]):,} rows and it has "
            f"{len(rows):,}; copy it again, or correct that line"
        )
    return OwnersList(where, tuple(columns), rows)


def attributes_of(source: Source, stem: str, names: Sequence[str]) -> Labels | None:
    """Every attribute as 1 yes, 0 no, -1 unknown (no row) for these images; None without the list."""
    listed = read_owners_list(source, stem, ("-1", "0", "1"), " of -1 or 1")
    if listed is None:
        return None
    rows = {name: np.array([value == "1" for value in row], np.int8) for name, row in listed.rows.items()}
    unknown = np.full(len(listed.columns), -1, np.int8)
    values = np.array([rows.get(name, unknown) for name in names], np.int8).reshape(len(names), -1)
    return {column: values[:, place].copy() for place, column in enumerate(listed.columns)}


def partition_of(source: Source, names: Sequence[str]) -> np.ndarray | None:
    """The official part of each image of CelebA, "" where it has no row; None without the list."""
    meaning = " of 0 (train), 1 (validation) or 2 (test)"
    listed = read_owners_list(source, "list_eval_partition", tuple(PARTITIONS), meaning)
    if listed is None:
        return None
    return text_column(PARTITIONS[listed.rows[name][0]] if name in listed.rows else "" for name in names)


def _read_celeba(source: Source, subset: str | None) -> Table:
    """Attributes, and identity and the official partition where their lists are there; boxes in the wild."""
    if not _is_celeba(source):
        raise ValueError(f"{source.path} has no list_attr_celeba.txt; CelebA's owners publish it at {HOME}")
    files, in_the_wild = _images(source)
    names = [base_name(file) for file in files]
    labels = attributes_of(source, "list_attr_celeba", names) or {}
    identities = read_owners_list(source, "identity_CelebA")
    if identities is not None:
        labels["identity"] = text_column(identities.rows.get(name, [""])[0] for name in names)
    boxes = _face_boxes(source, files, names) if in_the_wild else None
    table = Table(files, labels, partition_of(source, names), boxes)
    return part_of(table, source, subset, "list_eval_partition.txt")


def _is_celeba(source: Source) -> bool:
    return source.named("list_attr_celeba.txt", "list_attr_celeba.csv") is not None


def _images(source: Source) -> tuple[tuple[str, ...], bool]:
    """Aligned images if there are any, else those in the wild, else all; and whether they are wild."""
    for folder in ("img_align_celeba", "img_celeba"):
        files = tuple(file for file in source.images if folder in PurePosixPath(file).parts[:-1])
        if files:
            return files, folder == "img_celeba"
    if not source.images:
        raise ValueError(
            f"{source.path} has CelebA's list of attributes and no images: expected img_align_celeba or "
            f"img_celeba, unpacked; CelebA's owners publish both at {HOME}"
        )
    return source.images, False


def _face_boxes(source: Source, files: Sequence[str], names: Sequence[str]) -> Float32[np.ndarray, "n 4"]:
    """A box about each face in the wild (left, top, right, bottom); NaN for an image without a row."""
    own = read_box_list(source, files)
    if own is not None:
        return own
    landmarks = read_owners_list(source, "list_landmarks_celeba")
    if landmarks is not None:
        return _square_of_landmarks(landmarks.numbers(_EYES_AND_MOUTH, names))
    boxes = read_owners_list(source, "list_bbox_celeba")
    if boxes is not None:
        box = boxes.numbers(_BOX, names)
        return _square(box[:, :2] + box[:, 2:] / 2, box[:, 2:].max(axis=1))
    raise ValueError(
        f"{source.path} holds CelebA's images in the wild (img_celeba), which are cropped to their "
        f"face, but neither list_landmarks_celeba.txt nor list_bbox_celeba.txt; the owners publish both "
        f"at {HOME}. A list of your own may stand in for them: {BOX_LISTS[0]}, with rows of "
        f"file,left,top,width,height"
    )


def _square_of_landmarks(points: Float32[np.ndarray, "n 8"]) -> Float32[np.ndarray, "n 4"]:
    left_eye, right_eye, left_mouth, right_mouth = (points[:, at : at + 2] for at in (0, 2, 4, 6))
    eyes, mouth = (left_eye + right_eye) / 2, (left_mouth + right_mouth) / 2
    apart = np.linalg.norm(right_eye - left_eye, axis=1)
    down = np.linalg.norm(eyes - mouth, axis=1)
    return _square(eyes + 0.1 * (eyes - mouth), np.maximum(4 * apart, 3.6 * down))


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
