"""Tables of scores beside controls: one value for the terminal, a page, Markdown, LaTeX, pandas and JSON.

A protocol gives ``Scores``: its tables (the main one first) and its numbers. ``scored_table`` and
``verdict_table`` make tables of rows that were scored with resamples. Leaves out computing scores.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite, nan
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from derender.evaluation.bootstrap import ScoredRow

if TYPE_CHECKING:
    import pandas


class Interval(NamedTuple):
    """Both ends of a 95 % interval, in the unit of its score; NaN where there is none."""

    low: float
    high: float


Cell = float | int | str | Interval | None
ARROWS = {"high": " ↑", "low": " ↓", None: ""}


@dataclass(frozen=True)
class Column:
    """One column of numbers: its head, the better end (None where they are no score), digits after the point.
    A note has range, unit and meaning; ``of`` is the score whose interval or deviation the column holds. Its
    numbers are those of a score times ``scale``."""

    name: str
    best: Literal["high", "low"] | None = None
    digits: int = 3
    note: str = ""
    of: str = ""
    scale: float = 1.0

    @property
    def head(self) -> str:
        """The name and an arrow to the better end."""
        return self.name + ARROWS[self.best]

    def text(self, cell: Cell) -> str:
        """A cell as text; a dash where there is no number."""
        if isinstance(cell, Interval):
            between = " to " if cell.low < 0 else "-"
            return f"{self.text(cell.low)}{between}{self.text(cell.high)}" if isfinite(cell.low) else "-"
        if cell is None or (isinstance(cell, float) and not isfinite(cell)):
            return "-"
        if isinstance(cell, str):
            return cell
        return f"{cell:,}" if isinstance(cell, int) else f"{round(cell, self.digits) + 0.0:.{self.digits}f}"


@dataclass(frozen=True)
class Row:
    """One row: its name, one cell per column, and whether it is a control (it learned nothing)."""

    name: str
    cells: Sequence[Cell]
    control: bool = False
    note: str = ""


@dataclass(frozen=True)
class ScoreTable:
    """Rows of numbers under named columns, one cell for each; the first row is the subject of the table.

    ``caption`` says the score and the data, ``first`` is the head of the column of row names.
    """

    caption: str
    first: str
    columns: Sequence[Column]
    rows: Sequence[Row]

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row.cells) != len(self.columns):
                raise ValueError(f"row {row.name!r}: {len(row.cells)} cells for {len(self.columns)} columns")

    def numbers(self, column: int) -> list[float]:
        """Every finite number of one column."""
        return [number for row in self.rows if (number := _number(row.cells[column])) is not None]

    def largest(self, column: int) -> float:
        """The largest absolute number of a column, 0 without any."""
        return max(map(abs, self.numbers(column)), default=0.0)

    def best(self, column: int) -> float | None:
        """The best number of a column; None where the column is no score or there is nothing to compare."""
        numbers, end = self.numbers(column), self.columns[column].best
        if end is None or len(numbers) < 2:
            return None
        return max(numbers) if end == "high" else min(numbers)

    def texts(self, row: Row) -> list[tuple[str, bool]]:
        """Each cell of a row as text, and whether it is the best of its column."""
        best = map(self.best, range(len(self.columns)))
        cells = zip(self.columns, row.cells, best, strict=True)
        return [(column.text(cell), cell is not None and cell == top) for column, cell, top in cells]

    def values(self) -> dict[str, dict[str, Cell]]:
        """Row name to column name to cell."""
        names = [column.name for column in self.columns]
        return {row.name: dict(zip(names, row.cells, strict=True)) for row in self.rows}

    def verdict(self, column: int) -> str:
        """In words: whether the first row is better than every control in one column."""
        head, (first, *others) = self.columns[column], self.rows
        judged = [row for row in others if row.control] or others
        value, shown = _number(first.cells[column]), head.text(first.cells[column])
        rivals = {row.name: score for row in judged if (score := _number(row.cells[column])) is not None}
        if value is None or not rivals:
            return f"{first.name}: {shown} ({head.name})"
        sign = -1 if head.best == "low" else 1
        name, strongest = max(rivals.items(), key=lambda rival: sign * rival[1])
        if sign * value > sign * strongest:
            return f"better than every control: {shown} against {head.text(strongest)} ({name})"
        if value == strongest:
            return f"level with the strongest control: {shown} ({name})"
        beaten = [rival for rival, score in rivals.items() if sign * value > sign * score]
        rest = f", but ahead of {', '.join(beaten)}" if beaten else ""
        return f"behind the strongest control: {shown} against {head.text(strongest)} ({name}){rest}"

    def to_pandas(self) -> "pandas.DataFrame":
        """A data frame with one row for each row, named by it, and a last column ``control`` (bool).

        An interval becomes two columns, such as ``accuracy low`` and ``accuracy high``.

        Raises:
            ImportError: pandas is not installed.
        """
        try:
            import pandas
        except ImportError as error:
            raise ImportError("to_pandas() needs pandas: pip install pandas") from error
        data: dict[str, list[Any]] = {}
        for place, column in enumerate(self.columns):
            cells = [row.cells[place] for row in self.rows]
            if any(isinstance(cell, Interval) for cell in cells):
                for end in Interval._fields:
                    data[f"{column.of} {end}".lstrip()] = [getattr(cell, end, nan) for cell in cells]
            else:
                data[f"{column.of} {column.name}".lstrip()] = cells
        names = pandas.Index([row.name for row in self.rows], name=self.first)
        return pandas.DataFrame({**data, "control": [row.control for row in self.rows]}, index=names)

    def to_markdown(self) -> str:
        """The caption, a table with the best of each column bold and controls in italics, and the notes."""
        head, *rows = self._marked(_markdown, "*{}*", "**{}**")
        lines = [head, [":---", *("---:" for _ in self.columns)], *rows]
        notes = "; ".join(f"{column.name}: {column.note}" for column in self.columns if column.note)
        table = ["| " + " | ".join(cells) + " |" for cells in lines]
        return "\n".join([self.caption, "", *table, *(["", notes] if notes else []), ""])

    __str__ = to_markdown

    def to_latex(self) -> str:
        """A table environment; it needs ``\\usepackage{booktabs}``."""
        lines = self._marked(_latex, r"\textit{{{}}}", r"\textbf{{{}}}")
        head, *rows = (" & ".join(cells) + r" \\" for cells in lines)
        begin = [r"\begin{table}", r"\centering", rf"\caption{{{_latex(self.caption)}}}"]
        begin += [rf"\begin{{tabular}}{{l{'r' * len(self.columns)}}}", r"\toprule", head, r"\midrule"]
        end = [r"\bottomrule", r"\end{tabular}", r"\end{table}", ""]
        return "\n".join([*begin, *rows, *end])

    def _marked(self, escape: Callable[[str], str], control: str, best: str) -> list[list[str]]:
        """Escaped heads, then names and cells; controls and the best of each column in their marks."""
        lines = [[escape(self.first), *(escape(column.head) for column in self.columns)]]
        for row in self.rows:
            name = (control if row.control else "{}").format(escape(row.name))
            cells = [(best if marked else "{}").format(escape(text)) for text, marked in self.texts(row)]
            lines.append([name, *cells])
        return lines


@dataclass(frozen=True)
class Scores:
    """The result of a protocol: its tables, the main one first, and every number as ``--json`` writes it.

    ``notes`` are sentences on it, ``result`` the protocol's own value behind the tables, for charts.
    """

    tables: Sequence[ScoreTable]
    values: Mapping[str, Any]
    notes: Sequence[str] = ()
    result: Any = field(default=None, repr=False)

    def to_pandas(self) -> "pandas.DataFrame":
        """The main table as a data frame, see ``ScoreTable.to_pandas``."""
        return self.tables[0].to_pandas()

    def to_markdown(self) -> str:
        """Every table, one after another."""
        return "\n".join(table.to_markdown() for table in self.tables)

    __str__ = __repr__ = _repr_markdown_ = to_markdown

    def to_latex(self) -> str:
        """Every table environment, one after another."""
        return "\n".join(table.to_latex() for table in self.tables)


def scored_table(
    caption: str, first: str, rows: Sequence[ScoredRow], columns: Mapping[str, Column], *,
    intervals: Sequence[str] | None = None, deviations: Sequence[str] | None = None,
    more: Mapping[Column, Callable[[ScoredRow], Cell]] | None = None, over: str = "scored rows",
) -> ScoreTable:  # fmt: skip
    """One row for each scored row, one column for each score in ``columns``.

    Scores in ``intervals`` are followed by their 95 % interval, those in ``deviations`` by their standard
    deviation over seeds; by default the first. ``more`` gives further columns, each with a function of
    the row. Resamples are ``over`` these.
    """
    main = list(columns)[:1]
    shown: dict[Column, Callable[[ScoredRow], Cell]] = {}
    for name, column in columns.items():
        shown[column] = lambda row, name=name, by=column.scale: by * row.scores[name].value
        if name in (main if intervals is None else intervals):
            shown |= interval_cells(name, column, over)
        if name in (main if deviations is None else deviations):
            note = f"standard deviation of {column.name} over seeds"
            spread = Column("±", None, column.digits, note, column.name)
            shown[spread] = lambda row, name=name, by=column.scale: by * row.scores[name].deviation
    shown |= more or {}
    cells = [Row(row.name, [cell(row) for cell in shown.values()], row.control) for row in rows]
    return ScoreTable(caption, first, tuple(shown), cells)


def interval_column(column: Column, over: str = "scored rows") -> Column:
    """The column that holds the interval of another one's score."""
    note = f"interval of {column.name} over resamples of the {over}"
    return Column("95 %", None, column.digits, note, column.name)


def interval_cells(
    score: str, column: Column, over: str = "scored rows"
) -> dict[Column, Callable[[ScoredRow], Cell]]:
    """The column of a score's interval with a function of the row, as ``scored_table`` takes ``more``."""

    def cell(row: ScoredRow) -> Interval:
        return Interval(column.scale * row.scores[score].low, column.scale * row.scores[score].high)

    return {interval_column(column, over): cell}


VERDICT_COLUMNS = (
    Column("difference", None, note="to the strongest control, on the same resamples"),
    Column("low"),
    Column("high"),
    Column("strongest control"),
    Column("above", note="whether the whole 95 % interval lies above 0"),
)


def verdict_table(rows: Sequence[ScoredRow], columns: Mapping[str, Column], caption: str) -> ScoreTable:
    """Which row is above the strongest control, in each score named by a column, and by how much."""
    results = []
    for row in rows:
        for name, one in row.versus.items():
            if name in columns and isfinite(row.scores[name].low):
                cells = (one.value, one.low, one.high, one.rival, "yes" if one.above else "no")
                results.append(Row(f"{row.name}: {columns[name].name}", cells))
    return ScoreTable(caption, "features: score", VERDICT_COLUMNS, results)


def judged_tables(
    caption: str, first: str, rows: Sequence[ScoredRow], columns: Mapping[str, Column], asked: str, **how: Any
) -> list[ScoreTable]:
    """The table of scored rows, whose arguments ``how`` are, and that of verdicts, captioned ``asked``."""
    return [scored_table(caption, first, rows, columns, **how), verdict_table(rows, columns, asked)]


def verdict(row: ScoredRow, score: str, column: Column) -> str:
    """In words, in the unit of the score's column: whether a row is better than the strongest control."""
    own, one = row.scores[score].value, row.versus.get(score)
    shown = f"{row.name}: {column.name} {column.text(column.scale * own)}"
    if one is None or not isfinite(one.low):
        return shown
    how = "better than" if one.above else "worse than" if one.high < 0 else "not distinguished from"
    ends = [f"{column.scale * value:+.{column.digits}f}" for value in (one.value, one.low, one.high)]
    return f"{shown}, {how} the strongest control ({one.rival}), by {ends[0]}, 95 % {ends[1]} to {ends[2]}"


def _number(cell: Cell) -> float | None:
    return cell if isinstance(cell, float | int) and isfinite(cell) else None


def _markdown(text: str) -> str:
    """Text that stays in its cell and is not read as emphasis."""
    return " ".join(text.split()).replace("|", r"\|").replace("*", r"\*").replace("_", r"\_")


def _latex(text: str) -> str:
    return " ".join(text.split()).translate(_LATEX)


_LATEX = str.maketrans(
    {letter: rf"\{letter}" for letter in "{}$&#%_"}
    | {"\\": r"\textbackslash{}", "^": r"\textasciicircum{}", "~": r"\textasciitilde{}"}
    | {"±": r"$\pm$", "≥": r"$\geq$", "↑": r"$\uparrow$", "↓": r"$\downarrow$"}
)
