"""A list that says which part of each image is read, brought by the user and lying beside the images.

``boxes.csv`` (or ``boxes.txt``): a first line ``file,left,top,width,height`` or
``file,left,top,right,bottom``, then a row for each image, in pixels from its upper left corner.
``celeba_crop_bbox.txt`` is the name of the list of faces that unsup3d publishes for CelebA's images in the
wild (github.com/elliottwu/unsup3d, issue 30). How its rows are laid out is written nowhere that we found, so
rows without a first line of names are taken for a name, left, top, width and height. Values may be parted by
commas or by white space; a line with nothing but a count may come first. Leaves out images of the same name
in several folders.
"""

import io
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32
from PIL import Image

from derender.data.image import DECODER_ERRORS, upright_size
from derender.data.layouts.layout import base_name
from derender.data.names import suggestion
from derender.data.source import Source

BOX_LISTS = ("boxes.csv", "boxes.txt", "celeba_crop_bbox.txt", "celeba_crop_bbox.csv")
_SIZED = ("left", "top", "width", "height")
_SIDES = ("left", "top", "right", "bottom")
_COLUMNS = {_SIZED: _SIZED, _SIDES: _SIDES, ("x_1", "y_1", "width", "height"): _SIZED}
_MOST_OPENED = 1000

Box = tuple[int, tuple[float, float, float, float]]
"""The number of a line, and left, top, right, bottom."""


def read_box_list(source: Source, files: Sequence[str]) -> Float32[np.ndarray, "n 4"] | None:
    """Left, top, right and bottom for every one of these images, or None where no list lies in the source.

    Raises:
        ValueError: a row that is none, a second row of an image, an image without a row, or a box of which
            less than half lies in its image (looked up in at most 1,000 images, evenly spaced).
    """
    name = source.named(*BOX_LISTS)
    if name is None:
        return None
    where = f"{name} in {source.path}"
    boxes = _boxes(where, source.read_text(name).splitlines())
    images = [base_name(file) for file in files]
    missing = [image for image in images if image not in boxes]
    if missing:
        close = suggestion(missing[0], boxes) if len(boxes) < _MOST_OPENED else ""
        raise ValueError(
            f"{where} has no row for {missing[0]} ({len(missing):,} of {len(files):,} images have none"
            f"{close}); add the rows, or move these images or the list out of the folder"
        )
    opened = min(len(files), _MOST_OPENED)
    for at in (i * len(files) // opened for i in range(opened)):
        _check_inside(where, source, files[at], boxes[images[at]])
    return np.array([boxes[image][1] for image in images], np.float32).reshape(len(files), 4)


def _boxes(where: str, lines: Sequence[str]) -> dict[str, Box]:
    boxes: dict[str, Box] = {}
    columns, started = _SIZED, False
    for number, text in enumerate(lines, 1):
        line = text.strip()
        if not line or (not started and line.isdecimal()):
            continue
        name, *cells = [cell.strip() for cell in line.split(",")] if "," in line else line.rsplit(None, 4)
        name, values = base_name(name.replace("\\", "/")), [_number(cell) for cell in cells]
        if not started and not any(np.isfinite(values)):
            key = tuple(cell.lower() for cell in cells)
            if key not in _COLUMNS:
                known = " or ".join(",".join(("file", *one)) for one in (_SIZED, _SIDES))
                there = ", ".join(cells) or "of no name"
                raise ValueError(f"{where}, line {number}: expected {known}, got columns {there}")
            columns = _COLUMNS[key]
        else:
            if len(values) != 4 or not all(np.isfinite(values)):
                expected = f"an image's name and {', '.join(columns)}"
                raise ValueError(f"{where}, line {number}: expected {expected}, got {line!r}")
            left, top, right, bottom = values
            if columns is _SIZED:
                right, bottom = left + right, top + bottom
            if right <= left or bottom <= top:
                expected = f"expected {', '.join(columns)}, got {line!r}"
                raise ValueError(f"{where}, line {number}: the box has no area; {expected}")
            if name in boxes:
                raise ValueError(f"{where}, line {number}: a second row for {name}; keep one of them")
            boxes[name] = number, (left, top, right, bottom)
        started = True
    if not boxes:
        raise ValueError(f"{where} has no rows: expected an image's name and {', '.join(_SIZED)} in each")
    return boxes


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return np.nan


def _check_inside(where: str, source: Source, file: str, box: Box) -> None:
    """Raise if less than half of the box lies in the image; an unreadable image is listed elsewhere."""
    line, (left, top, right, bottom) = box
    try:
        with Image.open(io.BytesIO(source.read(file))) as opened:
            width, height = upright_size(opened)
    except DECODER_ERRORS:
        return
    inside = max(0.0, min(right, width) - max(left, 0)) * max(0.0, min(bottom, height) - max(top, 0))
    if inside < 0.5 * (right - left) * (bottom - top):
        raise ValueError(
            f"{where}, line {line}: the box from ({left:g}, {top:g}) to ({right:g}, {bottom:g}) lies "
            f"outside {base_name(file)}, which is {width} x {height} pixels; say in the first line "
            f"whether boxes are file,{','.join(_SIZED)} or file,{','.join(_SIDES)}"
        )
