"""A table of scores beside controls, as a value: made once, shown on a page, at a terminal or as JSON.

The second half makes one from each protocol's result. Leaves out computing scores (see
``derender.evaluation``).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Literal

from derender.evaluation import (
    ClusteringResult,
    FactorResult,
    GeometryResult,
    GeometryScores,
    ReconstructionResult,
)

Cell = float | int | str | None


@dataclass(frozen=True)
class Column:
    """One column of numbers.

    Attributes:
        name: shown in the head.
        best: which end is better; None where the numbers are no score.
        digits: after the point.
        note: range and meaning.
    """

    name: str
    best: Literal["high", "low"] | None = None
    digits: int = 3
    note: str = ""

    def text(self, cell: Cell) -> str:
        """A cell as people read it; a dash where there is no number."""
        if cell is None or (isinstance(cell, float) and not isfinite(cell)):
            return "-"
        if isinstance(cell, str):
            return cell
        return f"{cell:,}" if isinstance(cell, int) else f"{cell:.{self.digits}f}"


@dataclass(frozen=True)
class Row:
    """One row: its name, one cell per column, and whether it is a control (it learned nothing)."""

    name: str
    cells: Sequence[Cell]
    control: bool = False
    note: str = ""


@dataclass(frozen=True)
class ScoreTable:
    """Rows of numbers under named columns; the first row is what the table is about.

    Attributes:
        caption: what was scored, on what.
        first: head of the column of row names.
    """

    caption: str
    first: str
    columns: Sequence[Column]
    rows: Sequence[Row]

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row.cells) != len(self.columns):
                raise ValueError(
                    f"row {row.name!r} has {len(row.cells)} cells for {len(self.columns)} columns"
                )

    def numbers(self, column: int) -> list[float]:
        """Every finite number of one column."""
        cells = (row.cells[column] for row in self.rows)
        return [cell for cell in cells if isinstance(cell, float | int) and isfinite(cell)]

    def best(self, column: int) -> float | None:
        """The best number of a column; None where the column is no score or there is nothing to compare."""
        numbers, end = self.numbers(column), self.columns[column].best
        if end is None or len(numbers) < 2:
            return None
        return max(numbers) if end == "high" else min(numbers)

    def largest(self, column: int) -> float:
        return max((abs(value) for value in self.numbers(column)), default=0.0)

    def values(self) -> dict[str, dict[str, Cell]]:
        """Row name to column name to cell."""
        names = [column.name for column in self.columns]
        return {row.name: dict(zip(names, row.cells, strict=True)) for row in self.rows}

    def verdict(self, column: int) -> str:
        """In words: whether the first row is better than every control in one column."""
        column_, (first, *others) = self.columns[column], self.rows
        value = first.cells[column]
        sign = -1 if column_.best == "low" else 1
        rivals = [
            (row.name, row.cells[column]) for row in others if isinstance(row.cells[column], float | int)
        ]
        if not isinstance(value, float | int) or not rivals:
            return f"{first.name}: {column_.text(value)} ({column_.name})"
        name, strongest = max(rivals, key=lambda rival: sign * float(rival[1] or 0))
        shown, other = column_.text(value), column_.text(strongest)
        if sign * value > sign * float(strongest or 0):
            return f"better than every control: {shown} against {other} ({name})"
        if value == strongest:
            return f"level with the strongest control: {shown} ({name})"
        beaten = [rival for rival, score in rivals if sign * value > sign * float(score or 0)]
        rest = f", but ahead of {', '.join(beaten)}" if beaten else ""
        return f"behind the strongest control: {shown} against {other} ({name}){rest}"


def clustering_table(results: Mapping[str, ClusteringResult], controls: Sequence[str] = ()) -> ScoreTable:
    """One row for each set of features, names in ``controls`` set back, and a row for random clusters."""
    if not results:
        raise ValueError("a clustering table needs at least one result")
    first = next(iter(results.values()))
    columns = (
        Column("accuracy", "high", note="weighted purity, 0 to 1"),
        Column("F1", "high", note="weighted F1 of majority labels, 0 to 1"),
        Column("NMI", "high", note="normalised mutual information, 0 to 1"),
        Column("matched", "high", note="share of rows under the best one-to-one matching, 0 to 1"),
        Column("ARI", "high", note="adjusted Rand index, 0 for random clusters, at most 1"),
    )

    def row(name: str, scores: object, control: bool, note: str = "") -> Row:
        cells = [getattr(scores, field) for field in ("accuracy", "f1", "nmi", "hungarian", "ari")]
        return Row(name, cells, control, note)

    rows = [row(name, result.scores, name in controls) for name, result in results.items()]
    rows.append(row("chance", first.chance, True, "clusters of the same sizes, rows dealt at random"))
    caption = (
        f"Ward clustering: {first.n_rows:,} rows, {first.n_classes} classes, {first.n_clusters} clusters; "
        f"always answering the most frequent class gives {first.majority:.3f} accuracy"
    )
    if first.n_dropped:
        caption += f"; {first.n_dropped:,} rows without label left out"
    return ScoreTable(caption, "features", columns, rows)


def geometry_table(result: GeometryResult, pictures: int) -> ScoreTable:
    """Depth and normal errors beside average depth, a plane and, where it was scored, an untrained model."""
    columns = (
        Column("SIDE x 100", "low", note="scale-invariant depth error times 100, best 0"),
        Column("MAD", "low", 1, "mean angle between normals in degrees, best 0"),
        Column(
            "coverage",
            None,
            note="share of the true object that the prediction covers; errors count only there",
        ),
    )

    def row(name: str, scores: GeometryScores, control: bool, note: str = "") -> Row:
        return Row(name, (100 * scores.side, scores.mad_deg, scores.coverage), control, note)

    rows = [
        row("model", result.model, False),
        row(
            "average depth", result.average_depth, True, "the mean true depth map, the same for every picture"
        ),
        row("plane", result.plane, True),
    ]
    if result.untrained is not None:
        rows.append(row("untrained model", result.untrained, True, "same networks, fresh weights"))
    return ScoreTable(f"Geometry on {pictures:,} pictures with exact depth", "prediction", columns, rows)


def factor_table(result: FactorResult, pictures: int, untrained: FactorResult | None = None) -> ScoreTable:
    """Errors of albedo, light and camera beside the best constant answers and an untrained model's."""
    columns = (
        Column("albedo", "low", 4, "root mean square error after each picture's best scale, best 0"),
        Column("one scale", "low", 4, "the same after one scale for all pictures"),
        Column("light", "low", 1, "mean angle in degrees between true and found direction, best 0"),
        Column("aligned", "low", 1, "the same after the best rotation of all directions at once"),
        Column("camera", "low", 1, "mean angle in degrees of the rotation left over, best 0"),
    )

    def row(name: str, scores: FactorResult, control: bool = False) -> Row:
        errors = (scores.albedo, scores.albedo_global)
        angles = (scores.light, scores.light_aligned, scores.camera)
        return Row(name, (*errors, *(angle.mean_deg for angle in angles)), control)

    light = result.light_control.mean_deg
    constant = (result.albedo_control, result.albedo_global_control, light, light)
    note = "mean albedo, mean light, a camera that never turns"
    rows = [
        row("model", result),
        Row("constant answer", (*constant, result.camera_control.mean_deg), True, note),
    ]
    if untrained is not None:
        rows.append(row("untrained model", untrained, control=True))
    return ScoreTable(f"Albedo, light and camera on {pictures:,} pictures", "prediction", columns, rows)


def reconstruction_table(result: ReconstructionResult, pictures: int, components: str = "PCA") -> ScoreTable:
    """How well pictures are rendered again, beside the controls that were scored.

    ``components`` is what the row of principal components is called.
    """
    columns = (
        Column("L1", "low", 4, "mean absolute difference inside the mask, 0 to 1, best 0"),
        Column("PSNR", "high", 2, "peak signal-to-noise ratio in decibels"),
        Column("SSIM", "high", note="structural similarity of windows inside the mask, at most 1"),
        Column("coverage", None, note="share of all pixels inside the mask"),
    )
    scored = {"model": result.model, "mean picture": result.mean_picture}
    if result.components is not None:
        scored[components] = result.components
    if result.untrained is not None:
        scored["untrained model"] = result.untrained
    notes = {"untrained model": "same networks, fresh weights, inside its own mask"}
    rows = [
        Row(name, (s.l1, s.psnr_db, s.ssim, s.coverage), name != "model", notes.get(name, ""))
        for name, s in scored.items()
    ]
    return ScoreTable(f"Reconstruction of {pictures:,} pictures", "prediction", columns, rows)
