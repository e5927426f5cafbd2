"""Labelled grids of images drawn into one image: panels, contact sheets, and sheets of many rows.

Leaves out where the images come from (``decomposition``, ``edits``) and writing files. In an HTML page use
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
ROWS_PER_SHEET = 16

Font = ImageFont.FreeTypeFont | ImageFont.ImageFont


@dataclass(frozen=True)
class GridLayout:
    """Sizes of a grid in pixels."""

    cell: int = 160
    gap: int = 8
    margin: int = 20
    label: int = 17
    title: int = 24

    def top(self, title: str) -> int:
        """Where the grid begins below its title, if it has one."""
        return self.margin + (self.title + self.label if title else 0)

    def sheet(self, width: int, height: int, title: str) -> tuple[Image.Image, ImageDraw.ImageDraw, Font]:
        """An empty sheet with its title, what draws on it, and the font of its labels."""
        sheet = Image.new("RGB", (width, height), PAPER)
        draw = ImageDraw.Draw(sheet)
        if title:
            draw.text((self.margin, self.margin), title, INK, ImageFont.load_default(self.title))
        return sheet, draw, ImageFont.load_default(self.label)

    def height_of(self, images: Images) -> int:
        """Height of the tallest image at the width of a cell."""
        return max(enlarged(image, self.cell).height for image in images)


def labelled_grid(
    columns: Mapping[str, Images],
    row_labels: Sequence[str] | None = None,
    title: str = "",
    layout: GridLayout | None = None,
) -> Image.Image:
    """One row per image, one column per entry of ``columns`` under its name; row labels at the left."""
    layout = layout or GridLayout()
    rows = same_length(list(columns.values()))
    if row_labels is not None and len(row_labels) != rows:
        raise ValueError(f"expected {rows} row labels, one per image; got {len(row_labels)}")
    labels = row_labels or []
    left = layout.margin + _label_width(labels, layout)
    top = layout.top(title) + layout.label + layout.gap
    heights = [layout.height_of([images[row] for images in columns.values()]) for row in range(rows)]
    width = left + len(columns) * (layout.cell + layout.gap) - layout.gap + layout.margin
    height = top + sum(heights) + layout.gap * (rows - 1) + layout.margin
    sheet, draw, font = layout.sheet(width, height, title)
    tops = [top + sum(heights[:row]) + layout.gap * row for row in range(rows)]
    for index, (name, images) in enumerate(columns.items()):
        x = left + index * (layout.cell + layout.gap)
        label = shortened(name, font, layout.cell)
        draw.text((x + layout.cell // 2, top - layout.gap), label, INK, font, anchor="ms")
        for image, y in zip(images, tops, strict=True):
            sheet.paste(on_background(enlarged(image, layout.cell), PAPER), (x, y))
    for label, y, row_height in zip(labels, tops, heights, strict=False):
        text = shortened(label, font, left - layout.margin - 2 * layout.gap)
        draw.text((left - 2 * layout.gap, y + row_height // 2), text, FAINT, font, anchor="rm")
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
    cell_height = layout.height_of(images) + (layout.label + layout.gap if captions is not None else 0)
    width = 2 * layout.margin + across * (layout.cell + layout.gap) - layout.gap
    rows, top = ceil(len(images) / across), layout.top(title)
    height = top + rows * (cell_height + layout.gap) - layout.gap + layout.margin
    sheet, draw, font = layout.sheet(width, height, title)
    for index, image in enumerate(images):
        x = layout.margin + index % across * (layout.cell + layout.gap)
        y = top + index // across * (cell_height + layout.gap)
        sheet.paste(on_background(enlarged(image, layout.cell), PAPER), (x, y))
        if captions is not None:
            text = shortened(captions[index], font, layout.cell)
            place = (x + layout.cell // 2, y + cell_height - layout.gap // 2)
            draw.text(place, text, FAINT, font, anchor="ms")
    return sheet


class Sheets:
    """Rows of images with the same columns, drawn as sheets of a few rows each.

    Cells are scaled down as they come, so that memory grows with the sheet and not with the images' size.
    """

    layout = GridLayout(cell=128)

    def __init__(self, rows: int = ROWS_PER_SHEET):
        self.rows = rows
        self._labels: list[str] = []
        self._columns: dict[str, Images] = {}

    def __len__(self) -> int:
        return len(self._labels)

    def add(self, label: str, images: Mapping[str, Image.Image]) -> None:
        """One row; every row has the same columns."""
        if self._labels and list(images) != list(self._columns):
            raise ValueError(f"a sheet has the columns {', '.join(self._columns)}; got {', '.join(images)}")
        self._labels.append(label)
        for name, image in images.items():
            self._columns.setdefault(name, []).append(enlarged(image, self.layout.cell))

    def drawn(self) -> Images:
        """The sheets, in order; none where nothing was added."""
        return [
            labelled_grid(
                {name: images[start : start + self.rows] for name, images in self._columns.items()},
                self._labels[start : start + self.rows],
                layout=self.layout,
            )
            for start in range(0, len(self), self.rows)
        ]


def strip(images: Images, gap: int = 0) -> Image.Image:
    """Images in one row without labels, transparency kept."""
    if not images:
        raise ValueError("a strip needs at least one image")
    width = sum(image.width for image in images) + gap * (len(images) - 1)
    row = Image.new("RGBA", (width, max(image.height for image in images)), (0, 0, 0, 0))
    x = 0
    for image in images:
        row.paste(image.convert("RGBA"), (x, 0))
        x += image.width + gap
    return row


def shortened(text: str, font: Font, width: int) -> str:
    """The text on one line, an ellipsis in its middle where it is wider than ``width`` pixels."""
    text = " ".join(text.split())
    if font.getlength(text) <= width:
        return text
    for kept in range(len(text) - 1, 1, -1):
        short = text[: (kept + 1) // 2].rstrip() + "…" + text[len(text) - kept // 2 :].lstrip()
        if font.getlength(short) <= width:
            return short
    return text[:1]


def _label_width(labels: Sequence[str], layout: GridLayout) -> int:
    if not labels:
        return 0
    font = ImageFont.load_default(layout.label)
    widest = max(font.getlength(" ".join(label.split())) for label in labels)
    return min(round(widest), 2 * layout.cell) + 2 * layout.gap
