"""The page of a comparison, and the summary of many methods on many data sets."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite

from derender import __version__
from derender.evaluation.bootstrap import ScoredRow
from derender.evaluation.score_table import Cell, Column, Row, ScoreTable
from derender.report import charts
from derender.report.page import DIRECTIONS, Page

Chart = tuple[str, str, str]
"""SVG text, its alternative text and its caption."""


def comparison_page(
    title: str,
    tables: Sequence[ScoreTable],
    *,
    lead: str = "",
    facts: Mapping[str, object] | None = None,
    failed: Sequence[str] = (),
) -> Page:
    """A self-contained page with the tables in reading order, one or two sentences (``lead``) over them.

    ``facts`` are models, data, seeds, settings; ``failed`` has a sentence for whatever is missing, with the
    reason.
    """
    if not tables:
        raise ValueError("a comparison needs at least one table")
    settings = {**(facts or {}), "derender": __version__}
    shown = [(table, chart_of(table)) for table in tables]
    return Page("comparison.html", title, lead, {"tables": shown, "failed": failed, "settings": settings})


def chart_of(table: ScoreTable) -> Chart | None:
    """Bars of the first column that is a score, controls in grey; None where there are fewer than two."""
    for place, column in enumerate(table.columns):
        cells = ((row.name, row.cells[place]) for row in table.rows)
        values = {name: float(x) for name, x in cells if isinstance(x, float | int) and isfinite(x)}
        if column.best is not None and len(values) > 1:
            models = [row.name for row in table.rows if not row.control]
            svg = charts.bars(values, f"{column.name} ({DIRECTIONS[column.best]})", models)
            alt = f"{column.name} of {', '.join(f'{name} {column.text(v)}' for name, v in values.items())}"
            return svg, alt, f"{column.name}; what learned nothing is grey."
    return None


@dataclass(frozen=True)
class Question:
    """One question under one protocol: ``columns`` of the summary, ``rows`` that were scored, by name.

    ``absent`` has the reason of every method that has no row.
    """

    name: str
    columns: Mapping[str, Column]
    rows: Mapping[str, ScoredRow]
    absent: Mapping[str, str]


def summary_table(protocol: str, questions: Sequence[Question], methods: Sequence[str]) -> ScoreTable:
    """A row for each method, then for each control, and the main scores of every question."""
    columns = [
        replace(column, name=f"{one.name}: {column.name}")
        for one in questions
        for column in one.columns.values()
    ]
    rows = []
    for name in dict.fromkeys((*methods, *(name for one in questions for name in one.rows))):
        cells: list[Cell] = []
        for one in questions:
            if (row := one.rows.get(name)) is not None:
                cells += [row.scores[score].value for score in one.columns]
            else:
                cells += ["failed" if name in one.absent else None, *[None] * (len(one.columns) - 1)]
        control = any(one.rows[name].control for one in questions if name in one.rows)
        rows.append(Row(name, cells, control))
    heads = {"cluster": "Clustering", "linear": "Few labels, penalised logistic regression"}
    return ScoreTable(f"{heads[protocol]}: all data sets", "features", columns, rows)
