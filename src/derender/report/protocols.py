"""Results of protocols: a page of tables, each with a chart; curves over angle; masks over images; a search.

The chart of curves has a panel for each axis. Controls are grey and dashed; the 95 % interval of the first
features is shaded. Masks stand beside the answers of several networks, with a legend; left and right of a
pair share a hue. Leaves out computing anything (``derender.evaluation``).
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import cycle
from math import ceil, isfinite
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import hsv_to_rgb
from PIL import Image

from derender import __version__
from derender.data import Progress, Unreadable, decode, open_images, quiet_pillow, read_image
from derender.evaluation.memory import content_hash
from derender.evaluation.robust import SCORES, CurveResult, RobustnessComparison, level_name
from derender.evaluation.score_table import ScoreTable
from derender.evaluation.segmentation import SegmentationComparison
from derender.features.neighbours import Found
from derender.report import colours
from derender.report.charts import SERIES, bars, side_by_side
from derender.report.colours import Images, png_bytes
from derender.report.page import DIRECTIONS, Page
from derender.report.panel import PAPER, GridLayout, contact_sheet, labelled_grid
from derender.storage.atomic import write_whole


def comparison_page(
    title: str, tables: Sequence[ScoreTable], *, lead: str, facts: Mapping[str, object],
    failed: Sequence[str] = (),
) -> Page:  # fmt: skip
    """A self-contained page with the tables in reading order, one or two sentences (``lead``) over them.

    ``facts`` are models, data, seeds, settings; ``failed`` has a sentence for whatever is missing, with the
    reason.
    """
    settings = {**facts, "derender": __version__}
    shown = [(table, chart_of(table)) for table in tables]
    return Page("comparison.html", title, lead, {"tables": shown, "failed": failed, "settings": settings})


def chart_of(table: ScoreTable) -> tuple[str, str, str] | None:
    """Bars of the first column that is a score, controls in grey; None where there are fewer than two.

    As SVG text, its alternative text and its caption.
    """
    for place, column in enumerate(table.columns):
        cells = ((row.name, row.cells[place]) for row in table.rows)
        values = {name: float(x) for name, x in cells if isinstance(x, float | int) and isfinite(x)}
        if column.best is not None and len(values) > 1:
            models = [row.name for row in table.rows if not row.control]
            svg = bars(values, f"{column.name} ({DIRECTIONS[column.best]})", models)
            alt = f"{column.name} of {', '.join(f'{name} {column.text(v)}' for name, v in values.items())}"
            return svg, alt, f"{column.name}; controls are grey."
    return None


CONTROL_LINES = ((0, (5, 2)), (0, (1, 1)), (0, (3, 1, 1, 1)), (0, (6, 1, 1, 1, 1, 1)))


def write_curves(result: RobustnessComparison, score: str, file: Path) -> None:
    """Write a chart of every curve, .svg or .png, with a panel for each axis."""

    def draw(axes: Axes, curve: CurveResult) -> None:
        dashes = cycle({"color": "#64748b", "linestyle": line} for line in CONTROL_LINES)
        colours = cycle({"color": colour, "marker": "o", "markersize": 3} for colour in SERIES[:-1])
        for row in curve.rows[score]:
            style = next(dashes if row.control else colours)
            axes.plot(curve.levels, curve.values(row), label=row.name, linewidth=1.6, **style)  # pyrefly: ignore[bad-argument-type]
        first = next((row for row in curve.rows[score] if not row.control), None)
        if first is not None:
            ends = [first.scores[level_name(level)] for level in curve.levels]
            low, high = [one.low for one in ends], [one.high for one in ends]
            axes.fill_between(curve.levels, low, high, color=SERIES[0], alpha=0.15, linewidth=0)
        axes.set_ylim(0, 1)
        if len({one.levels for one in result.curves}) == 1:  # panels share their ticks
            axes.set_xticks(curve.levels)
        axes.grid(True)
        if curve is result.curves[0]:
            axes.set_ylabel(SCORES[score])

    panels = {curve.title: curve for curve in result.curves}
    size = (1.2 + 3.6 * max(2, len(panels)), 3.9)
    chart = side_by_side(panels, draw, "degrees off the front", size, columns=5)
    write_whole(file, chart.png() if file.suffix.lower() == ".png" else chart.svg().encode())


FACE_PALETTE = (  # red, green, blue of CelebAMask-HQ's 19 classes in their order
    *((38, 40, 46), (240, 178, 140), (214, 112, 64), (122, 86, 196), (66, 134, 244), (120, 186, 255)),
    *((20, 120, 80), (64, 190, 130), (226, 160, 30), (252, 206, 92), (120, 8, 40), (228, 26, 74)),
    *((252, 108, 150), (104, 62, 30), (150, 150, 156), (255, 245, 60), (0, 206, 209), (198, 148, 170)),
    (70, 92, 120),
)

OPACITY = 0.62


def palette(n_classes: int) -> np.ndarray:
    """(C, 3) uint8: the faces' colours, then further ones spaced by the golden angle."""
    more = [(0.11 + 0.618034 * place) % 1 for place in range(n_classes - len(FACE_PALETTE))]
    further = [np.rint(255 * hsv_to_rgb((hue, 0.75, 0.9))) for hue in more]
    return np.array([*FACE_PALETTE, *further], np.uint8)[:n_classes]


def overlays(pictures: np.ndarray, masks: np.ndarray, n_classes: int, *, scale: int = 1) -> Images:
    """Masks (N, S, S) in colours over images (N, 3, S, S) uint8; every pixel becomes ``scale`` squared."""
    tints = np.moveaxis(palette(n_classes)[masks], -1, 1)
    mixed = (1 - OPACITY) * pictures.astype(np.float32) + OPACITY * tints
    return _larger(np.rint(mixed).astype(np.uint8), scale)


def segmentation_sheet(
    pictures: np.ndarray, masks: np.ndarray, answers: Mapping[str, np.ndarray], classes: Sequence[str],
    layout: GridLayout | None = None,
) -> Image.Image:  # fmt: skip
    """A row for each image (N, 3, S, S) uint8: itself, its true mask (N, S, S), every answer by name.

    The legend of the classes, named by number, is below.
    """
    layout = layout or GridLayout()
    scale = ceil(layout.cell / masks.shape[-1])  # pixels stay squares when the grid shrinks them
    columns = {"picture": _larger(pictures, scale)}
    for name, shown in {"mask": masks, **answers}.items():
        columns[name] = overlays(pictures, shown, len(classes), scale=scale)
    grid = labelled_grid(columns, layout=layout)
    swatches = [Image.new("RGB", (8, 1), tuple(colour)) for colour in palette(len(classes)).tolist()]
    key = contact_sheet(swatches, classes, across=len(columns), layout=layout)
    sheet = Image.new("RGB", (grid.width, grid.height + key.height), PAPER)
    sheet.paste(grid, (0, 0))
    sheet.paste(key, (0, grid.height))
    return sheet


def write_overlays(result: SegmentationComparison, out: Path) -> Path:
    """Write the sheet of overlays; its name changes with the answers."""
    answers = {row.scored.name: row.shown for row in result.rows if row.trainable}
    images, truth = result.data.images[result.shown], result.data.masks[result.shown]
    sheet = segmentation_sheet(images, truth, answers, result.data.classes)
    mark = content_hash({"pictures": images, "mask": truth, **answers})[:8]
    return write_whole(out / f"overlays-{mark}.png", png_bytes(sheet))


def _larger(images: np.ndarray, scale: int) -> Images:
    """Every pixel of (N, 3, S, S) repeated ``scale`` times each way."""
    return colours.pictures(images.repeat(scale, axis=2).repeat(scale, axis=3))


CELL = 192


def search_sheet(
    result: Found, out: Path, images: str | None, *, dataset: str, progress: Progress
) -> list[str]:
    """Write the query and the nearest images as a contact sheet; gives the names of those it cannot read.

    ``images`` is the address of the table's images; None is the one that the table records. ``dataset`` is
    their layout, or "auto". ``progress`` is called with (images read, all).

    Raises:
        ValueError: the address is not known, or holds none of the images.
    """
    address = images if images is not None else str(result.table.origin.get("data", ""))
    if not address:
        raise ValueError("the table does not record where its images are: give their address")
    captions = {result.table.files[row]: "query" for row in [result.own_row] if row is not None}
    for row, distance in zip(result.rows, result.distances, strict=True):
        captions.setdefault(result.table.files[row], f"{distance:.3f}")
    missing, read = set(captions), {}
    with open_images(address, dataset=dataset) as stream, quiet_pillow():
        for sample in stream.samples():
            if sample.file in missing:
                missing.remove(sample.file)
                with suppress(Unreadable, ValueError, OSError):
                    read[sample.file] = decode(sample.read(), CELL, sample.fit, sample.box)
                progress(len(read), len(captions))
            if not missing:
                break
    if not read:
        some = list(captions)[-1]
        raise ValueError(f"{address} holds none of the images found, such as {some!r}: give another address")
    shown = [] if result.own_row is not None else [("query", read_image(Path(result.like), CELL))]
    shown += [(caption, read[file]) for file, caption in captions.items() if file in read]
    names, drawn = zip(*shown, strict=True)
    title, layout = f"nearest by {result.factor}", GridLayout(cell=CELL)
    sheet = contact_sheet(colours.pictures(np.stack(drawn)), names, across=7, title=title, layout=layout)
    write_whole(out, png_bytes(sheet))
    return [file for file in captions if file not in read]
