"""Labelled grids of images drawn into one PNG-ready picture: panels, contact sheets, before/after.

Leaves out where the images come from (``figures``) and writing files. In an HTML page use
``blocks.image_grid``, whose labels are text.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import ceil

from PIL import Image, ImageDraw, ImageFont

from derender.report.colours import Images, enlarged, on_background, same_length

INK = (28, 30, 34)
FAINT = (120, 124, 132)
PAPER = (255, 255, 255)


@dataclass(frozen=True)
class GridLayout:
    """Sizes of a grid in pixels."""

    cell: int = 160
    gap: int = 8
    margin: int = 20
    label: int = 17
    title: int = 24


def labelled_grid(
    columns: Mapping[str, Images],
    row_labels: Sequence[str] | None = None,
    title: str = "",
    layout: GridLayout | None = None,
) -> Image.Image:
    """One row per picture, one column per entry of ``columns`` under its name; row labels at the left."""
    layout = layout or GridLayout()
    rows = same_length(list(columns.values()))
    if row_labels is not None and len(row_labels) != rows:
        raise ValueError(f"expected {rows} row labels, one per picture; got {len(row_labels)}")
    font = ImageFont.load_default(layout.label)
    left = layout.margin + _label_width(row_labels or [], font, layout)
    top = layout.margin + (layout.title + layout.label if title else 0) + layout.label + layout.gap
    heights = [_row_height(columns, row, layout) for row in range(rows)]
    width = left + len(columns) * (layout.cell + layout.gap) - layout.gap + layout.margin
    height = top + sum(heights) + layout.gap * (rows - 1) + layout.margin
    sheet = Image.new("RGB", (width, height), PAPER)
    draw = ImageDraw.Draw(sheet)
    if title:
        draw.text((layout.margin, layout.margin), title, INK, ImageFont.load_default(layout.title))
    for index, (name, images) in enumerate(columns.items()):
        x = left + index * (layout.cell + layout.gap)
        label = shortened(name, font, layout.cell)
        draw.text((x + layout.cell // 2, top - layout.gap), label, INK, font, anchor="ms")
        y = top
        for image, row_height in zip(images, heights, strict=True):
            sheet.paste(on_background(enlarged(image, layout.cell), PAPER), (x, y))
            y += row_height + layout.gap
    y = top
    for label, row_height in zip(row_labels or [], heights, strict=False):
        text = shortened(label, font, left - layout.margin - 2 * layout.gap)
        draw.text((left - 2 * layout.gap, y + row_height // 2), text, FAINT, font, anchor="rm")
        y += row_height + layout.gap
    return sheet


def contact_sheet(
    images: Images,
    captions: Sequence[str] | None = None,
    across: int = 8,
    title: str = "",
    layout: GridLayout | None = None,
) -> Image.Image:
    """Many images in reading order, ``across`` a row, each with its caption below."""
    layout = layout or GridLayout(cell=96, gap=6, label=13)
    if not images:
        raise ValueError("a contact sheet needs at least one image")
    if captions is not None and len(captions) != len(images):
        raise ValueError(f"expected {len(images)} captions, one per image; got {len(captions)}")
    across = min(across, len(images))
    font = ImageFont.load_default(layout.label)
    caption_height = layout.label + layout.gap if captions is not None else 0
    cell_height = max(enlarged(image, layout.cell).height for image in images) + caption_height
    top = layout.margin + (layout.title + layout.label if title else 0)
    rows = ceil(len(images) / across)
    width = 2 * layout.margin + across * (layout.cell + layout.gap) - layout.gap
    height = top + rows * (cell_height + layout.gap) - layout.gap + layout.margin
    sheet = Image.new("RGB", (width, height), PAPER)
    draw = ImageDraw.Draw(sheet)
    if title:
        draw.text((layout.margin, layout.margin), title, INK, ImageFont.load_default(layout.title))
    for index, image in enumerate(images):
        x = layout.margin + index % across * (layout.cell + layout.gap)
        y = top + index // across * (cell_height + layout.gap)
        sheet.paste(on_background(enlarged(image, layout.cell), PAPER), (x, y))
        if captions is not None:
            text = shortened(captions[index], font, layout.cell)
            draw.text(
                (x + layout.cell // 2, y + cell_height - layout.gap // 2), text, FAINT, font, anchor="ms"
            )
    return sheet


def before_after(before: Images, after: Images, names: tuple[str, str] = ("before", "after")) -> Image.Image:
    """Pairs side by side, one row per picture."""
    return labelled_grid({names[0]: before, names[1]: after})


def strip(images: Images, cell: int | None = None, gap: int = 0) -> Image.Image:
    """Images in one row without labels, transparency kept."""
    cells = [enlarged(image, cell).convert("RGBA") if cell else image.convert("RGBA") for image in images]
    if not cells:
        raise ValueError("a strip needs at least one image")
    width = sum(image.width for image in cells) + gap * (len(cells) - 1)
    row = Image.new("RGBA", (width, max(image.height for image in cells)), (0, 0, 0, 0))
    x = 0
    for image in cells:
        row.paste(image, (x, 0))
        x += image.width + gap
    return row


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


def _row_height(columns: Mapping[str, Images], row: int, layout: GridLayout) -> int:
    return max(enlarged(images[row], layout.cell).height for images in columns.values())


def _label_width(
    labels: Sequence[str], font: ImageFont.FreeTypeFont | ImageFont.ImageFont, layout: GridLayout
) -> int:
    if not labels:
        return 0
    widest = max(font.getlength(" ".join(label.split())) for label in labels)
    return min(round(widest), 2 * layout.cell) + 2 * layout.gap
