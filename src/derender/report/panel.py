"""Labelled grids of images drawn into one image: panels, contact sheets, and sheets of many rows.

Leaves out where the images come from (``decomposition``, ``edits``) and writing files. In an HTML page use
the macro ``image_grid`` of ``templates/blocks.html``, whose labels are text.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from derender.report.colours import Images, enlarged, on_background

INK = (28, 30, 34)
FAINT = (120, 124, 132)
PAPER = (255, 255, 255)
ROWS_PER_SHEET = 16


@dataclass(frozen=True)
class GridLayout:
    """Sizes of a grid in pixels."""

    cell: int = 160
    gap: int = 8
    margin: int = 20
    label: int = 17
    title: int = 24


SHEET = GridLayout(cell=128)  # of sheets with a row for each image


def labelled_grid(
    columns: Mapping[str, Images], row_labels: Sequence[str] | None = None, title: str = "",
    layout: GridLayout | None = None,
) -> Image.Image:  # fmt: skip
    """One row per image, one column per entry of ``columns`` under its name; row labels at the left."""
    cells = [list(row) for row in zip(*columns.values(), strict=True)]
    return _grid(cells, layout or GridLayout(), title, heads=list(columns), labels=row_labels or [])


def contact_sheet(
    images: Images, captions: Sequence[str] | None = None, across: int = 8, title: str = "",
    layout: GridLayout | None = None,
) -> Image.Image:  # fmt: skip
    """Many images in reading order, ``across`` a row, each with its caption below."""
    rows = [images[start : start + across] for start in range(0, len(images), across)]
    return _grid(rows, layout or GridLayout(cell=96, gap=6, label=13), title, captions=captions or [])


def _grid(
    rows: Sequence[Images], layout: GridLayout, title: str, *, heads: Sequence[str] = (),
    labels: Sequence[str] = (), captions: Sequence[str] = (),
) -> Image.Image:  # fmt: skip
    """Images in rows with heads over columns, labels at the left of rows, and captions in reading order."""
    font, line = ImageFont.load_default(layout.label), layout.label + layout.gap
    left, step = layout.margin, layout.cell + layout.gap
    if labels:
        widest = max(font.getlength(" ".join(label.split())) for label in labels)
        left += min(round(widest), 2 * layout.cell) + 2 * layout.gap
    top = layout.margin + (layout.title + layout.label if title else 0) + (line if heads else 0)
    scaled = [[on_background(enlarged(image, layout.cell)) for image in row] for row in rows]
    heights = [max(image.height for image in row) + (line if captions else 0) for row in scaled]
    width = left + len(rows[0]) * step - layout.gap + layout.margin
    height = top + sum(heights) + layout.gap * (len(rows) - 1) + layout.margin
    sheet = Image.new("RGB", (width, height), PAPER)
    draw = ImageDraw.Draw(sheet)

    def write(text: str, x: int, y: int, colour: tuple[int, int, int], room: int, anchor: str) -> None:
        draw.text((x, y), shortened(text, font, room), colour, font, anchor=anchor)

    if title:
        draw.text((layout.margin, layout.margin), title, INK, ImageFont.load_default(layout.title))
    for column, head in enumerate(heads):
        write(head, left + column * step + layout.cell // 2, top - layout.gap, INK, layout.cell, "ms")
    captions_left, y = iter(captions), top
    for number, (row, height) in enumerate(zip(scaled, heights, strict=True)):
        if labels:
            room = left - layout.margin - 2 * layout.gap
            write(labels[number], left - 2 * layout.gap, y + height // 2, FAINT, room, "rm")
        for column, image in enumerate(row):
            x = left + column * step
            sheet.paste(image, (x, y))
            if captions:
                middle, below = x + layout.cell // 2, y + height - layout.gap // 2
                write(next(captions_left), middle, below, FAINT, layout.cell, "ms")
        y += height + layout.gap
    return sheet


def row_sheets(rows: Sequence[tuple[str, Mapping[str, Image.Image]]], most: int = ROWS_PER_SHEET) -> Images:
    """Labelled rows of images with the same columns, as sheets of at most so many rows; none without rows."""
    return [
        labelled_grid(
            {name: [images[name] for _, images in part] for name in part[0][1]},
            [label for label, _ in part],
            layout=SHEET,
        )
        for part in (rows[start : start + most] for start in range(0, len(rows), most))
    ]


def strip(images: Images, gap: int = 0) -> Image.Image:
    """Images of one height in one row without labels, transparency kept."""
    between = np.zeros((images[0].height, gap, 4), np.uint8)
    cells = [cell for image in images for cell in (between, np.asarray(image.convert("RGBA")))]
    return Image.fromarray(np.concatenate(cells[1:], axis=1))


def shortened(text: str, font: ImageFont.FreeTypeFont | ImageFont.ImageFont, width: int) -> str:
    """The text on one line, an ellipsis in its middle where it is wider than ``width`` pixels."""
    text = " ".join(text.split())
    if font.getlength(text) <= width:
        return text
    for kept in range(len(text) - 1, 1, -1):
        short = text[: (kept + 1) // 2].rstrip() + "…" + text[len(text) - kept // 2 :].lstrip()
        if font.getlength(short) <= width:
            return short
    return text[:1]
