"""One page for a comparison: its tables as they stand, a chart for each, what was compared, what failed.

Leaves out computing anything (``derender.evaluation``).
"""

from collections.abc import Mapping, Sequence
from math import isfinite
from textwrap import shorten

from derender import __version__
from derender.evaluation.score_table import ScoreTable
from derender.report import blocks, charts
from derender.report.blocks import Html
from derender.report.page import Page, Section

LONGEST_HEAD = 40


def comparison_page(
    title: str,
    tables: Sequence[ScoreTable],
    *,
    lead: str = "",
    facts: Mapping[str, object] | None = None,
    failed: Sequence[str] = (),
    picture: str | None = None,
) -> Page:
    """A self-contained page.

    Args:
        title: its heading.
        tables: in reading order; controls in them stay set back.
        lead: one or two sentences under the heading.
        facts: what was compared and how: models, data, seeds, settings.
        failed: a sentence for whatever is missing, with the reason.
        image: SVG text that stands over the tables; the first of them then has no chart of its own.
    """
    if not tables:
        raise ValueError("a comparison needs at least one table")
    sections = [
        Section(f"{number}. {table.caption}", [*_above(number, table, picture), blocks.table(table)],
                _short(number, table))
        for number, table in enumerate(tables, 1)
    ]  # fmt: skip
    missing = [blocks.prose(reason) for reason in failed]
    sections.append(
        Section("What failed", missing or [blocks.prose("Nothing that was noticed.")], "Failed"),
    )
    settings = {**(facts or {}), "derender": __version__}
    sections.append(Section("What was compared, and how", [blocks.facts(settings)], "Settings"))
    return Page(title, lead, sections, f"derender {__version__}")


def chart_of(table: ScoreTable) -> list[Html]:
    """Bars of the first column that is a score, controls in grey; nothing where there are fewer than two."""
    for place, column in enumerate(table.columns):
        values = {
            row.name: float(cell)
            for row in table.rows
            if isinstance(cell := row.cells[place], float | int) and isfinite(cell)
        }
        if column.best is None or len(values) < 2:
            continue
        models = [row.name for row in table.rows if not row.control]
        better = {"high": "more is better", "low": "less is better"}[column.best]
        svg = charts.bars(values, f"{column.name} ({better})", models)
        alt = f"{column.name} of {', '.join(f'{name} {column.text(v)}' for name, v in values.items())}"
        return [blocks.chart(svg, alt, f"{column.name}; what learned nothing is grey.")]
    return []


def _above(number: int, table: ScoreTable, picture: str | None) -> list[Html]:
    """What stands over a table: its chart, or over the first the image that was given."""
    if picture is None or number > 1:
        return chart_of(table)
    return [
        blocks.chart(picture, table.caption, "What learned nothing is grey; whiskers are 95 % intervals.")
    ]


def _short(number: int, table: ScoreTable) -> str:
    """The table's name in the navigation."""
    head = table.caption.partition(":")[0].partition(";")[0]
    return f"{number} {shorten(head, LONGEST_HEAD, placeholder='…')}".strip()
