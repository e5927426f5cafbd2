"""The page of a comparison: tables of scores, each with a chart of its first score, settings, what failed."""

from collections.abc import Mapping, Sequence
from math import isfinite

from derender import __version__
from derender.evaluation.score_table import ScoreTable
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
            return svg, alt, f"{column.name}; controls are grey."
    return None
