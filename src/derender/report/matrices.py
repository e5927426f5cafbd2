"""Matrices as one picture: a row of labelled heat maps with their numbers, and whole correlation matrices.

One colour scale for the sheet, white at 0. Leaves out computing the matrices and the page
(``report/page.py``).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from derender.evaluation.disentanglement import DisentanglementCard

MAP = "Blues"
CELL_NUMBERS_UP_TO = 400  # cells; larger matrices are shown without numbers


@dataclass(frozen=True)
class Matrix:
    """One heat map.

    Attributes:
        title: above it.
        values: (rows, columns), clipped to 0..1 for the colour; NaN is grey.
        rows, columns: names of the rows and columns, or of equal groups of them.
        sizes: where the names stand for groups: how many rows and columns each takes.
        note: below it: what would be best.
    """

    title: str
    values: np.ndarray
    rows: Sequence[str]
    columns: Sequence[str]
    sizes: Sequence[int] | None = None
    note: str = ""

    def __post_init__(self) -> None:
        expected = (
            (len(self.rows), len(self.columns)) if self.sizes is None else (sum(self.sizes), sum(self.sizes))
        )
        if self.values.shape != expected:
            raise ValueError(f"{self.title}: a matrix {self.values.shape} does not fit its names {expected}")


def card_matrices(card: DisentanglementCard) -> list[Matrix]:
    """The matrices of a disentanglement card, means over seeds, the model's own."""
    names, scores = card.features, next(iter(card.rows.values()))
    first = scores[0]

    def mean(values: Sequence[np.ndarray]) -> np.ndarray:
        return np.mean(values, axis=0)

    found = [
        Matrix(
            "|Pearson| of all dimensions",
            card.correlations,
            names,
            names,
            card.dimensions,
            "best: white outside the blocks",
        ),
        Matrix(
            "mean |Pearson|",
            mean([s.pearson.per_dimension for s in scores]),
            names,
            names,
            note="best: 0 off the diagonal",
        ),
        Matrix(
            "CKA, unbiased",
            mean([s.similarity.cka_unbiased for s in scores]),
            names,
            names,
            note="best: 0 off the diagonal",
        ),
        Matrix(
            "cross-prediction R2",
            mean([s.similarity.cross_r2 for s in scores]),
            names,
            names,
            note="row predicts column; best: 0 off the diagonal",
        ),
    ]
    if first.swap is not None:
        swaps = [s.swap for s in scores if s.swap is not None]
        note = "row exchanged, column moved; best: identity"
        found.append(Matrix("swap: features", mean([s.moved for s in swaps]), names, names, note=note))
        found.append(
            Matrix("swap: decoded", mean([s.moved_parameters for s in swaps]), names, names, note=note)
        )
    if first.truth is not None:
        truths = [s.truth for s in scores if s.truth is not None]
        found.append(
            Matrix(
                "true factors: R2, accuracy of classes",
                mean([t.score for t in truths]),
                names,
                first.truth.factors,
                note="held out; best: one dark cell a column, in the right row",
            )
        )
    return found


def matrix_sheet(matrices: Sequence[Matrix], title: str = "", columns: int = 3) -> Image.Image:
    """All matrices on one white sheet; a matrix that is much wider than high takes a row of its own."""
    if not matrices:
        raise ValueError("a sheet needs at least one matrix")
    square = [m for m in matrices if m.values.shape[1] < 1.6 * m.values.shape[0]]
    wide = [m for m in matrices if m.values.shape[1] >= 1.6 * m.values.shape[0]]
    rows = -(-len(square) // columns)
    figure = Figure(figsize=(3.9 * columns, 3.9 * rows + 3.4 * len(wide)), layout="constrained", dpi=110)
    grid = figure.add_gridspec(
        rows + len(wide), columns, height_ratios=[3.9] * rows + [3.4] * len(wide), hspace=0.08, wspace=0.06
    )
    for place, matrix in enumerate(square):
        _draw(figure.add_subplot(grid[place // columns, place % columns]), matrix)
    for place, matrix in enumerate(wide):
        _draw(figure.add_subplot(grid[rows + place, :]), matrix)
    if title:
        figure.suptitle(title, fontsize=13)
    stream = BytesIO()
    figure.savefig(stream, format="png", facecolor="white", metadata={"Software": None})
    return Image.open(BytesIO(stream.getvalue())).convert("RGB")


def _draw(axes: Axes, matrix: Matrix) -> None:
    colours = colormaps[MAP].with_extremes(bad="#d9d9d9")
    values = np.ma.masked_invalid(matrix.values)
    axes.imshow(np.clip(values, 0, 1), cmap=colours, vmin=0, vmax=1, aspect="auto", interpolation="nearest")
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
        for end in ends[:-1]:
            axes.axhline(end - 0.5, color="#444", linewidth=0.6)
            axes.axvline(end - 0.5, color="#444", linewidth=0.6)
    crowded = len(matrix.columns) > 6
    axes.tick_params(length=0, labelsize=8)
    axes.tick_params(axis="x", rotation=30 if crowded else 0)
    axes.set_title(matrix.title, fontsize=10, loc="left")
    axes.set_xlabel(matrix.note, fontsize=8, color="#555")
    for spine in axes.spines.values():
        spine.set_visible(False)
