"""A list that says which part of each picture is read, brought by the user and lying beside the pictures.

``boxes.csv`` (or ``boxes.txt``): a first line ``file,left,top,width,height`` or
``file,left,top,right,bottom``, then a row for each picture, in pixels from its upper left corner.
``celeba_crop_bbox.txt`` is the name of the list of faces that unsup3d publishes for CelebA's pictures in the
wild (github.com/elliottwu/unsup3d, issue 30). How its rows are laid out is written nowhere that we found, so
rows without a first line of names are taken for a name, left, top, width and height. Values may be parted by
commas or by white space; a line with nothing but a count may come first. Leaves out pictures of the same name
in several folders.
"""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np
from jaxtyping import Float32
from PIL import Image

from derender.data.decode import DECODER_ERRORS
from derender.data.names import suggestion
from derender.data.source import Source

BOX_LISTS = ("boxes.csv", "boxes.txt", "celeba_crop_bbox.txt", "celeba_crop_bbox.csv")
_SIZED = ("left", "top", "width", "height")
_SIDES = ("left", "top", "right", "bottom")
_HEADERS = {_SIZED: True, _SIDES: False, ("x_1", "y_1", "width", "height"): True}
_MOST_OPENED = 1000
_LYING = (5, 6, 7, 8)  # EXIF orientations of pictures stored on their side
_ORIENTATION = 0x0112


@dataclass(frozen=True)
class _Row:
    line: int
    box: tuple[float, float, float, float]  # left, top, right, bottom


def read_box_list(source: Source, files: Sequence[str]) -> Float32[np.ndarray, "n 4"] | None:
    """Left, top, right and bottom for every one of these pictures, or None where no list lies in the source.

    Raises:
        ValueError: a row that is none, a second row of a picture, a picture without a row, or a box of which
            less than half lies in its picture (looked up in at most 1,000 pictures, evenly spread).
    """
    name = next((found for known in BOX_LISTS if (found := source.named(known)) is not None), None)
    if name is None:
        return None
    where = f"{name} in {source.path}"
    rows = _rows(where, source.read_text(name).splitlines())
    pictures = [PurePosixPath(file).name for file in files]
    missing = [picture for picture in pictures if picture not in rows]
    if missing:
        raise ValueError(
            f"{where} has no row for {missing[0]} ({len(missing):,} of {len(files):,} pictures have none"
            f"{suggestion(missing[0], rows) if len(rows) < _MOST_OPENED else ''}); add the rows, or move "
            f"these pictures or the list out of the folder"
        )
    opened = min(len(files), _MOST_OPENED)
    for at in (i * len(files) // opened for i in range(opened)):
        _check_inside(where, source, files[at], rows[pictures[at]])
    return np.array([rows[picture].box for picture in pictures], np.float32).reshape(len(files), 4)


def _rows(where: str, lines: Sequence[str]) -> dict[str, _Row]:
    rows: dict[str, _Row] = {}
    sized, started = True, False
    for number, text in enumerate(lines, 1):
        line = text.strip()
        if not line or (not started and line.isdecimal()):
            continue
        name, values = _fields(line)
        if not started and not any(map(_is_number, values)):
            sized = _header(f"{where}, line {number}", values)
        else:
            row = _Row(number, _box(f"{where}, line {number}", line, values, sized))
            if rows.setdefault(name, row) is not row:
                raise ValueError(f"{where}, line {number}: a second row for {name}; keep one of them")
        started = True
    if not rows:
        raise ValueError(f"{where} has no rows: expected a picture's name and {', '.join(_SIZED)} in each")
    return rows


def _fields(line: str) -> tuple[str, list[str]]:
    """A picture's name without its folders, and the values."""
    fields = [field.strip() for field in line.split(",")] if "," in line else line.rsplit(None, 4)
    return PurePosixPath(fields[0].replace("\\", "/")).name, fields[1:]


def _is_number(text: str) -> bool:
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False


def _header(where: str, columns: list[str]) -> bool:
    """Whether boxes have sizes rather than right and bottom."""
    key = tuple(column.lower() for column in columns)
    if key not in _HEADERS:
        known = " or ".join(",".join(("file", *columns)) for columns in (_SIZED, _SIDES))
        raise ValueError(f"{where}: expected {known}, got columns {', '.join(columns) or 'of no name'}")
    return _HEADERS[key]


def _box(where: str, line: str, values: list[str], sized: bool) -> tuple[float, float, float, float]:
    wanted = ", ".join(_SIZED if sized else _SIDES)
    if len(values) != 4 or not all(map(_is_number, values)):
        raise ValueError(f"{where}: expected a picture's name and {wanted}, got {line!r}")
    left, top, third, fourth = map(float, values)
    right, bottom = (left + third, top + fourth) if sized else (third, fourth)
    if right <= left or bottom <= top:
        raise ValueError(f"{where}: the box has no area; expected {wanted}, got {line!r}")
    return left, top, right, bottom


def _check_inside(where: str, source: Source, file: str, row: _Row) -> None:
    """Raise if less than half of the box lies in the picture; an unreadable picture is listed elsewhere."""
    try:
        with Image.open(io.BytesIO(source.read(file))) as picture:
            lying = picture.getexif().get(_ORIENTATION) in _LYING
            width, height = picture.size[::-1] if lying else picture.size
    except DECODER_ERRORS:
        return
    left, top, right, bottom = row.box
    inside = max(0.0, min(right, width) - max(left, 0)) * max(0.0, min(bottom, height) - max(top, 0))
    if inside < 0.5 * (right - left) * (bottom - top):
        raise ValueError(
            f"{where}, line {row.line}: the box from ({left:g}, {top:g}) to ({right:g}, {bottom:g}) lies "
            f"outside {PurePosixPath(file).name}, which is {width} x {height} pixels; say in the first line "
            f"whether boxes are file,{','.join(_SIZED)} or file,{','.join(_SIDES)}"
        )
