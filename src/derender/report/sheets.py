"""Contact sheets over many pictures: the same columns for each, so many rows to a sheet.

Cells are scaled down as they come, so that memory grows with the sheet and not with the pictures' size.
Leaves out a single picture's panel (``panel``).
"""

from collections.abc import Mapping
from pathlib import Path

from PIL import Image

from derender.report.colours import enlarged
from derender.report.panel import GridLayout, labelled_grid
from derender.storage.atomic import atomic_file

ROWS_PER_SHEET = 16
CELL = 128


class Sheets:
    """Collects a row of images per picture, and draws them as sheets.

    Args:
        title: drawn on top of each.
        rows: rows to a sheet.
    """

    def __init__(self, title: str = "", rows: int = ROWS_PER_SHEET):
        self.title, self.rows = title, rows
        self._labels: list[str] = []
        self._columns: dict[str, list[Image.Image]] = {}

    def add(self, label: str, images: Mapping[str, Image.Image]) -> None:
        """One picture's images by column; every picture has the same columns."""
        if self._labels and list(images) != list(self._columns):
            raise ValueError(f"a sheet has the columns {', '.join(self._columns)}; got {', '.join(images)}")
        self._labels.append(label)
        for name, image in images.items():
            self._columns.setdefault(name, []).append(enlarged(image, CELL))

    def __len__(self) -> int:
        return len(self._labels)

    def drawn(self) -> list[Image.Image]:
        """The sheets, in order; none where nothing was added."""
        return [
            labelled_grid(
                {name: images[start : start + self.rows] for name, images in self._columns.items()},
                self._labels[start : start + self.rows],
                self.title,
                GridLayout(cell=CELL),
            )
            for start in range(0, len(self), self.rows)
        ]


def sheet_paths(out: Path, count: int, rows: int = ROWS_PER_SHEET) -> list[Path]:
    """Where the sheets of ``count`` pictures lie: ``sheet.png``, or ``sheet-1.png`` and so on."""
    number = -(-count // rows)
    return [out / ("sheet.png" if number == 1 else f"sheet-{index}.png") for index in range(1, number + 1)]


def write_sheets(sheets: Sheets, out: Path) -> list[Path]:
    """Write all sheets, each whole or not at all."""
    paths = sheet_paths(out, len(sheets), sheets.rows)
    for path, sheet in zip(paths, sheets.drawn(), strict=True):
        with atomic_file(path) as temporary:
            sheet.save(temporary, format="PNG")
    return paths
