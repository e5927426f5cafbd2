"""Charts as SVG text that takes the colour of the page around it, and matrices as one image.

Charts are curves over training, bars with controls, and panels side by side. Text stays text; axes and labels
use ``currentColor``, so one chart serves light and dark pages and print. Matrices are a row of labelled heat
maps with their numbers, on one colour scale with white at 0. Leaves out interaction.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from io import BytesIO, StringIO
from itertools import cycle
from pathlib import Path
from typing import Any, TypeVar

import matplotlib
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from derender.evaluation.disentanglement.card import DisentanglementCard
from derender.report.colours import png_bytes
from derender.storage.atomic import write_whole

SERIES = ("#3b82f6", "#f59e0b", "#10b981", "#ec4899", "#8b5cf6", "#64748b")
CONTROL_COLOUR = "#94a3b8"
INK = "#010203"  # becomes currentColor when the SVG text is written: that of the page's text, light or dark
T = TypeVar("T")


def curves(series: Mapping[str, tuple[Sequence[float], Sequence[float]]], x_label: str, y_label: str) -> str:
    """Lines by name, each (x values, y values), as SVG text."""

    def draw(axes: Axes, _: object) -> None:
        for (name, (x, y)), colour in zip(series.items(), cycle(SERIES), strict=False):
            marker, label = "o" if len(x) < 2 else None, name if len(series) > 1 else None
            axes.plot(x, y, color=colour, linewidth=1.8, label=label, marker=marker)
        axes.set_ylabel(y_label)
        axes.grid(True)
        axes.margins(x=0.01)
        axes.xaxis.set_major_formatter(lambda x, _: f"{x:,.0f}" if float(x).is_integer() else f"{x:g}")

    # a legend at the upper left is seen where charts scroll
    return side_by_side({"": None}, draw, x_label, (7.2, 2.9), 3, "outside upper left").svg()


def bars(values: Mapping[str, float], x_label: str, highlighted: Sequence[str] = ()) -> str:
    """One bar a name, ``highlighted`` ones in colour, as SVG text."""
    names = list(values)[::-1]

    def draw(axes: Axes, _: object) -> None:
        tints = [SERIES[0] if name in highlighted else CONTROL_COLOUR for name in names]
        drawn = axes.barh(names, [values[name] for name in names], color=tints, height=0.66)
        axes.bar_label(drawn, fmt="%.3g", padding=4, fontsize=9)
        axes.margins(x=0.12)
        axes.tick_params(axis="y", length=0)

    return side_by_side({"": None}, draw, x_label, (7.2, 0.6 + 0.34 * len(values))).svg()


_styled = matplotlib.rc_context(fname=Path(__file__).with_suffix(".mplstyle"))


@_styled
def side_by_side(
    panels: Mapping[str, T], draw: Callable[[Axes, T], object], x_label: str, size: tuple[float, float],
    columns: int = 99, legend: Any = "outside lower left",
) -> "Chart":  # fmt: skip
    """Panels by title with one vertical axis, drawn from their values.

    A legend of the first panel's labels has at most so many columns.
    """
    figure = Figure(figsize=size, layout="constrained")
    drawn = list(figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)[0])
    for axes, (title, value) in zip(drawn, panels.items(), strict=True):
        draw(axes, value)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel(x_label)
        axes.patch.set_alpha(0)
    handles, labels = drawn[0].get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc=legend, ncols=min(columns, len(handles)))
    return Chart(figure)


@dataclass(frozen=True)
class Chart:
    """A drawn figure."""

    figure: Figure

    @_styled
    def png(self) -> bytes:
        """On white: an image file has no page behind it."""
        self.figure.savefig(stream := BytesIO(), format="png", dpi=150, metadata={"Software": None})
        return stream.getvalue()

    @_styled
    def svg(self) -> str:
        """The SVG element alone: no ground, no prologue, no metadata, ids of its own, the page's colour."""
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        self.figure.savefig(stream := StringIO(), format="svg", transparent=True, metadata=nothing)
        text = re.sub(r"^.*?(?=<svg)|<metadata>.*?</metadata>", "", stream.getvalue(), flags=re.DOTALL)
        text = text.replace(INK, "currentColor")
        text = re.sub(r' (?:width|height)="[^"]*"', "", text, count=2)  # of the <svg> itself
        text = re.sub(r"font: ([\d.]+)px [^;\"]*", r"font-size: \1px", text)
        text = re.sub(r"font-family: [^;\"]*;?", "", text)
        prefix = "c" + sha256(text.encode()).hexdigest()[:8]  # ids of two charts must not meet
        used = set(re.findall(r'(?:url\(#|href="#)([^)"]+)', text))
        text = re.sub(r' id="([^"]+)"', lambda m: f' id="{prefix}-{m[1]}"' if m[1] in used else "", text)
        return text.replace("url(#", f"url(#{prefix}-").replace('href="#', f'href="#{prefix}-')


BLUES = colormaps["Blues"].with_extremes(bad="#d9d9d9")
ACROSS = 3  # matrices in a row of the sheet


@dataclass(frozen=True)
class Matrix:
    """One heat map of values (rows, columns), clipped to 0..1 for the colour; NaN is grey.

    Where names of rows and columns stand for groups, ``sizes`` is how many each takes. The note is below.
    """

    title: str
    values: np.ndarray
    rows: Sequence[str]
    columns: Sequence[str]
    sizes: Sequence[int] | None = None
    note: str = ""


def card_matrices(card: DisentanglementCard) -> list[Matrix]:
    """The matrices of a disentanglement card, means over seeds, the model's own."""
    names, first = card.features, card.rows["model"][0]
    apart, identity = "best: 0 off the diagonal", "row exchanged, column moved; best: identity"
    shown = [
        ("pearson.per_dimension", "mean |Pearson|", apart, names),
        ("similarity.cka_unbiased", "CKA, unbiased", apart, names),
        ("similarity.cross_r2", "cross-prediction R2", f"row predicts column; {apart}", names),
    ]
    if first.swap is not None:
        titles = {"moved": "features", "moved_parameters": "decoded"}
        shown += [(f"swap.{path}", f"swap: {title}", identity, names) for path, title in titles.items()]
    if first.truth is not None:
        note = "held out; best: one dark cell a column, in the right row"
        shown.append(("truth.score", "true factors: R2, accuracy of classes", note, first.truth.factors))
    whole = "best: white outside the blocks"
    every = Matrix("|Pearson| of all dimensions", card.correlations, names, names, card.dimensions, whole)
    rest = (Matrix(title, card.mean(path), names, columns, note=note) for path, title, note, columns in shown)
    return [every, *rest]


def write_card(card: DisentanglementCard, title: str, file: Path) -> None:
    """Write all matrices of a card as one PNG."""
    write_whole(file, png_bytes(matrix_sheet(card_matrices(card), title)))


def matrix_sheet(matrices: Sequence[Matrix], title: str = "") -> Image.Image:
    """All matrices on one white sheet; a matrix that is much wider than high takes a row of its own."""
    wide = [matrix for matrix in matrices if matrix.values.shape[1] >= 1.6 * matrix.values.shape[0]]
    square = [matrix for matrix in matrices if matrix not in wide]
    heights = [3.9] * -(-len(square) // ACROSS) + [3.4] * len(wide)
    figure = Figure(figsize=(3.9 * ACROSS, sum(heights)), layout="constrained", dpi=110)
    grid = figure.add_gridspec(len(heights), ACROSS, height_ratios=heights, hspace=0.08, wspace=0.06)
    for place, matrix in enumerate(square):
        _draw_matrix(figure.add_subplot(grid[place // ACROSS, place % ACROSS]), matrix)
    for place, matrix in enumerate(wide, len(heights) - len(wide)):
        _draw_matrix(figure.add_subplot(grid[place, :]), matrix)
    if title:
        figure.suptitle(title, fontsize=13)
    stream = BytesIO()
    figure.savefig(stream, format="png", facecolor="white")
    return Image.open(stream).convert("RGB")


def _draw_matrix(axes: Axes, matrix: Matrix) -> None:
    values = np.clip(np.ma.masked_invalid(matrix.values), 0, 1)
    axes.imshow(values, cmap=BLUES, vmin=0, vmax=1, aspect="auto", interpolation="nearest")
    if matrix.sizes is None:
        axes.set_xticks(range(len(matrix.columns)), matrix.columns)
        axes.set_yticks(range(len(matrix.rows)), matrix.rows)
        if matrix.values.size <= 400:  # in more cells numbers cannot be read
            for (row, column), value in np.ndenumerate(matrix.values):
                shown = "-" if np.isnan(value) else f"{value:.2f}".replace("-0.00", "0.00")
                ink = "white" if value > 0.6 else "black"
                axes.text(column, row, shown, ha="center", va="center", fontsize=8, color=ink)
    else:
        ends = np.cumsum(matrix.sizes)
        middles = ends - np.asarray(matrix.sizes) / 2 - 0.5
        axes.set_xticks(middles, matrix.columns)
        axes.set_yticks(middles, matrix.rows)
        for end in ends[:-1] - 0.5:
            axes.axhline(end, color="#444", linewidth=0.6)
            axes.axvline(end, color="#444", linewidth=0.6)
    axes.tick_params(length=0, labelsize=8)
    axes.tick_params(axis="x", rotation=30 if len(matrix.columns) > 6 else 0)
    axes.set_title(matrix.title, fontsize=10, loc="left")
    axes.set_xlabel(matrix.note, fontsize=8, color="#555")
    axes.spines[:].set_visible(False)
