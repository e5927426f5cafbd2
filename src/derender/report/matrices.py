"""Matrices as one image: a row of labelled heat maps with their numbers, and whole correlation matrices.

One colour scale for the sheet, white at 0. Leaves out computing the matrices and the page
(``report/page.py``).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from derender.evaluation.disentanglement import DisentanglementCard
from derender.report.page import png_bytes
from derender.storage.atomic import write_whole

MAP = colormaps["Blues"].with_extremes(bad="#d9d9d9")
ACROSS = 3  # matrices in a row of the sheet
CELL_NUMBERS_UP_TO = 400  # cells; larger matrices are shown without numbers


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
        shown += [
            ("swap.moved", "swap: features", identity, names),
            ("swap.moved_parameters", "swap: decoded", identity, names),
        ]
    if first.truth is not None:
        note = "held out; best: one dark cell a column, in the right row"
        shown.append(("truth.score", "true factors: R2, accuracy of classes", note, first.truth.factors))
    whole = "best: white outside the blocks"
    found = [Matrix("|Pearson| of all dimensions", card.correlations, names, names, card.dimensions, whole)]
    for path, title, note, columns in shown:
        found.append(Matrix(title, card.mean(path), names, columns, note=note))
    return found


def write_card(card: DisentanglementCard, title: str, file: Path) -> None:
    """Write all matrices of a card as one PNG."""
    write_whole(file, png_bytes(matrix_sheet(card_matrices(card), title)))


def matrix_sheet(matrices: Sequence[Matrix], title: str = "") -> Image.Image:
    """All matrices on one white sheet; a matrix that is much wider than high takes a row of its own."""
    if not matrices:
        raise ValueError("a sheet needs at least one matrix")
    wide = [matrix for matrix in matrices if matrix.values.shape[1] >= 1.6 * matrix.values.shape[0]]
    square = [matrix for matrix in matrices if matrix not in wide]
    heights = [3.9] * -(-len(square) // ACROSS) + [3.4] * len(wide)
    figure = Figure(figsize=(3.9 * ACROSS, sum(heights)), layout="constrained", dpi=110)
    grid = figure.add_gridspec(len(heights), ACROSS, height_ratios=heights, hspace=0.08, wspace=0.06)
    for place, matrix in enumerate(square):
        _draw(figure.add_subplot(grid[place // ACROSS, place % ACROSS]), matrix)
    for place, matrix in enumerate(wide, len(heights) - len(wide)):
        _draw(figure.add_subplot(grid[place, :]), matrix)
    if title:
        figure.suptitle(title, fontsize=13)
    stream = BytesIO()
    figure.savefig(stream, format="png", facecolor="white")
    return Image.open(stream).convert("RGB")


def _draw(axes: Axes, matrix: Matrix) -> None:
    values = np.clip(np.ma.masked_invalid(matrix.values), 0, 1)
    axes.imshow(values, cmap=MAP, vmin=0, vmax=1, aspect="auto", interpolation="nearest")
    if matrix.sizes is None:
        axes.set_xticks(range(len(matrix.columns)), matrix.columns)
        axes.set_yticks(range(len(matrix.rows)), matrix.rows)
        if matrix.values.size <= CELL_NUMBERS_UP_TO:
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
