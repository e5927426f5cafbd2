"""Tables of scores as text to paste: Markdown, and LaTeX with booktabs.

The best number of a column is bold, controls are in italics, a number that is not there is a dash. Leaves out
the terminal (cli/console.py) and pages (blocks.py).
"""

from collections.abc import Iterable

from derender.report.score_table import Cell, Column, ScoreTable

_LATEX = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "$": r"\$",
    "&": r"\&",
    "#": r"\#",
    "%": r"\%",
    "_": r"\_",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
    "±": r"$\pm$",
    "≥": r"$\geq$",
}


def markdown(tables: Iterable[ScoreTable]) -> str:
    """Tables one after another, each under its caption."""
    return "\n".join(_markdown_table(table) for table in tables)


def latex(tables: Iterable[ScoreTable]) -> str:
    """Table environments one after another; they need ``\\usepackage{booktabs}``."""
    return "\n".join(_latex_table(table) for table in tables)


def _markdown_table(table: ScoreTable) -> str:
    arrows = {"high": " ↑", "low": " ↓", None: ""}
    head = [table.first, *(column.name + arrows[column.best] for column in table.columns)]
    lines = [_bars(map(_plain, head)), _bars([":---", *("---:" for _ in table.columns)])]
    for row in table.rows:
        name = f"*{_plain(row.name)}*" if row.control else _plain(row.name)
        cells = [
            f"**{_plain(text)}**" if best else _plain(text)
            for text, best in (_cell(table, at, cell) for at, cell in enumerate(row.cells))
        ]
        lines.append(_bars([name, *cells]))
    notes = "; ".join(f"{column.name}: {column.note}" for column in table.columns if column.note)
    return "\n".join([table.caption, "", *lines, *(["", notes] if notes else []), ""])


def _latex_table(table: ScoreTable) -> str:
    arrows = {"high": r" $\uparrow$", "low": r" $\downarrow$", None: ""}
    head = [_escaped(table.first), *(_escaped(c.name) + arrows[c.best] for c in table.columns)]
    lines = []
    for row in table.rows:
        name = rf"\textit{{{_escaped(row.name)}}}" if row.control else _escaped(row.name)
        cells = [
            rf"\textbf{{{_escaped(text)}}}" if best else _escaped(text)
            for text, best in (_cell(table, at, cell) for at, cell in enumerate(row.cells))
        ]
        lines.append(" & ".join([name, *cells]) + r" \\")
    return "\n".join(
        (
            r"\begin{table}",
            r"\centering",
            rf"\caption{{{_escaped(table.caption)}}}",
            rf"\begin{{tabular}}{{l{'r' * len(table.columns)}}}",
            r"\toprule",
            " & ".join(head) + r" \\",
            r"\midrule",
            *lines,
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
            "",
        )
    )


def _cell(table: ScoreTable, at: int, cell: Cell) -> tuple[str, bool]:
    column: Column = table.columns[at]
    return column.text(cell), cell is not None and cell == table.best(at)


def _bars(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _plain(text: str) -> str:
    """Text that stays in its cell and is not read as emphasis."""
    return " ".join(text.split()).replace("|", r"\|").replace("*", r"\*").replace("_", r"\_")


def _escaped(text: str) -> str:
    return "".join(_LATEX.get(letter, letter) for letter in " ".join(text.split()))
