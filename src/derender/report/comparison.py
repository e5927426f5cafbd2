"""The page of a comparison, and the tables and charts of many methods on many data sets.

Of a plan each protocol has one table, whose rows are methods and controls and whose columns are data sets.
Under it each data set has its own, with every score, its interval and the row's cost. What failed or is
missing says so in its place. Leaves out computing (``derender.learn.sweep``).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite, nan
from textwrap import shorten
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from derender import __version__
from derender.evaluation.bootstrap import Difference, Estimate, ScoredRow
from derender.evaluation.clustering import about_clustering
from derender.evaluation.clustering_scores import CLUSTER_COLUMNS
from derender.evaluation.linear_probing import LINEAR_COLUMNS, PROBE_NAMES
from derender.evaluation.score_table import Cell, Column, Row, ScoreTable, scored_table, verdict_table
from derender.report import charts
from derender.report.charts import CONTROL_COLOUR, INK, SERIES, side_by_side
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
    picture: str | None = None,
) -> Page:
    """A self-contained page with the tables in reading order, one or two sentences (``lead``) over them.

    ``facts`` are models, data, seeds, settings; ``failed`` has a sentence for whatever is missing, with the
    reason. ``picture`` is SVG text over the tables; the first of them then has no chart of its own.
    """
    if not tables:
        raise ValueError("a comparison needs at least one table")
    drawn = [chart_of(table) for table in tables]
    if picture is not None:
        caption = "What learned nothing is grey; whiskers are 95 % intervals."
        drawn[0] = picture, tables[0].caption, caption
    settings = {**(facts or {}), "derender": __version__}
    shown = list(zip(tables, drawn, strict=True))
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


SUMMARY_HEAD = "logistic"  # the head of the linear protocol that the one table shows
COST_COLUMNS = {
    "numbers": Column("numbers", None, note="that describe an image"),
    "parameters": Column("parameters", None, note="of all networks that were trained"),
    "images": Column("images seen", None, note="in training, repeats counted"),
    "seconds": Column("training, s", None, 0, note="wall time of the training loop, whatever else ran"),
    "embedding_seconds": Column("ms an image", None, 2, note="to embed, likewise"),
}
"""A row's cost on one data set by name; None where there is nothing to tell."""
Costs = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class ScoredQuestion:
    """One question under one protocol (and one ``head`` at one ``count`` of labels, for the linear one).

    ``about`` has rows, classes and the like in words. The ``main`` ones of the protocol's columns are in the
    one table, and the first is drawn. ``costs`` are by row, each by the names of ``COST_COLUMNS``; ``absent``
    says by method why it has no row: "failed: ..." or "missing: ...".
    """

    name: str
    about: str
    columns: Mapping[str, Column]
    main: tuple[str, ...]
    rows: Mapping[str, ScoredRow]
    costs: Costs
    absent: Mapping[str, str]
    head: str = ""
    count: int = 0

    def absence(self, name: str) -> str | None:
        """``failed`` or ``missing``; None where nothing is known of the method."""
        return self.absent[name].partition(":")[0] if name in self.absent else None


def scores_from(question: Mapping[str, Any], costs: Costs, absent: Mapping[str, str]) -> list[ScoredQuestion]:
    """The scores of a question as JSON keeps them: one of clusters, or one for each head and count."""
    name = str(question["name"])
    if question["protocol"] == "cluster":
        about = about_clustering(question["method"], question["n_rows"], question["labels"])
        rows = _rows_from(question["rows"])
        return [ScoredQuestion(name, about, CLUSTER_COLUMNS, ("accuracy", "nmi"), rows, costs, absent)]
    kind = "classes" if question["kind"] == "classes" else "yes/no labels"
    about = f"{question['n_test']:,} tested, {len(question['names'])} {kind}, {len(question['seeds'])} seeds"
    return [
        ScoredQuestion(
            f"{name}, {part['labels']:,} labels",
            f"{PROBE_NAMES.get(part['head'], part['head'])}, {about}",
            LINEAR_COLUMNS, ("balanced_accuracy",), _rows_from(part["rows"]), costs, absent,
            part["head"], part["labels"],
        )
        for part in question["parts"]
    ]  # fmt: skip


def _rows_from(values: Mapping[str, Any]) -> dict[str, ScoredRow]:
    """Rows as JSON keeps them: without resamples, null for NaN."""

    def numbers(one: Mapping[str, Any]) -> dict[str, Any]:
        named = {"deviation" if part == "spread" else part: value for part, value in one.items()}
        return {part: nan if value is None else value for part, value in named.items()}

    return {
        name: ScoredRow(
            name, row["control"], row["runs"],
            {score: Estimate(**numbers(one), resampled=np.empty(0)) for score, one in row["scores"].items()},
            {score: Difference(**numbers(one)) for score, one in row["versus"].items()},
        )
        for name, row in values.items()
    }  # fmt: skip


def protocol_table(scores: Sequence[ScoredQuestion], methods: Sequence[str]) -> ScoreTable:
    """The one table: a row for each method, then control, the main scores of each data set, and the cost.

    Scores are of one protocol; of the linear one those with ``SUMMARY_HEAD`` are shown.
    """
    shown = _shown(scores)
    columns = [
        replace(one.columns[score], name=f"{one.name}: {one.columns[score].name}", note=one.about)
        if score == one.main[0]
        else replace(one.columns[score], note="")
        for one in shown
        for score in one.main
    ]
    rows = []
    for name in dict.fromkeys((*methods, *(name for one in shown for name in one.rows))):
        cells: list[Cell] = []
        for one in shown:
            if name in one.rows:
                cells += [one.rows[name].scores[score].value for score in one.main]
            else:
                cells += [one.absence(name), *(None for _ in one.main[1:])]
        control = any(one.rows[name].control for one in shown if name in one.rows)
        rows.append(Row(name, (*cells, *_whole_cost(shown, name)), control))
    caption = f"Few labels, {PROBE_NAMES[shown[0].head]}" if shown[0].head else "Clustering"
    caption += ": all data sets; training time is the sum over training sets"
    return ScoreTable(caption, "features", (*columns, *COST_COLUMNS.values()), rows)


def set_tables(one: ScoredQuestion, methods: Sequence[str]) -> list[ScoreTable]:
    """One data set's own table, with every score, interval and cost, and who is above the controls."""
    rows = list(one.rows.values())
    costs = {
        column: lambda row, place=place: _cost_cells(one.costs.get(row.name, {}))[place]
        for place, column in enumerate(COST_COLUMNS.values())
    }
    table = scored_table(f"{one.name}: {one.about}", "features", rows, one.columns, more=costs)
    result = {row.name: row for row in table.rows}
    blank = [None] * (len(table.columns) - 1 - len(COST_COLUMNS))
    for name in one.absent.keys() - result.keys():
        why = shorten(one.absent[name], 60, placeholder=" ...")  # the page and the Markdown say it whole
        result[name] = Row(name, (why, *blank, *_cost_cells(one.costs.get(name, {}))))
    order = dict.fromkeys((*methods, *one.rows))
    verdict = verdict_table(rows, one.columns, f"{one.name}, above the strongest control? {one.about}")
    return [replace(table, rows=[result[name] for name in order if name in result]), verdict]


def protocol_picture(scores: Sequence[ScoredQuestion], methods: Sequence[str]) -> tuple[str, bytes]:
    """A panel of bars for each data set, methods in colour, controls grey, as SVG text and as PNG.

    Whiskers are 95 % intervals. Of the linear protocol the largest number of labels is shown.
    """
    shown = _shown(scores)
    most = max(one.count for one in shown)
    shown = [one for one in shown if one.count == most]
    names = list(dict.fromkeys((*methods, *(name for one in shown for name in one.rows))))
    score = shown[0].main[0]

    def panel(axes: Axes, one: ScoredQuestion) -> None:
        for place, name in enumerate(reversed(names)):
            if (row := one.rows.get(name)) is None:
                axes.barh(name, 0)
                axes.annotate(one.absence(name) or "", (0, place), xytext=(3, 0), textcoords="offset points",
                              va="center", fontsize=8, alpha=0.75)  # fmt: skip
                continue
            own = row.scores[score]
            axes.barh(name, own.value, color=CONTROL_COLOUR if row.control else SERIES[0], height=0.66)
            if isfinite(own.low):
                axes.plot([own.low, own.high], [name, name], color=INK, alpha=0.6, linewidth=1)
        axes.tick_params(axis="y", length=0)
        axes.grid(True, axis="x")
        axes.set_axisbelow(True)

    size = (max(7.2, 1.6 + 2.1 * len(shown)), 0.9 + 0.3 * len(names))
    return side_by_side({one.name: one for one in shown}, panel, score.replace("_", " "), size)


def _shown(scores: Sequence[ScoredQuestion]) -> list[ScoredQuestion]:
    """What the one table and the image show: one head."""
    heads = {one.head for one in scores}
    head = SUMMARY_HEAD if SUMMARY_HEAD in heads else scores[0].head
    return [one for one in scores if one.head == head]


def _whole_cost(scores: Sequence[ScoredQuestion], name: str) -> list[Cell]:
    """A method's cost over several data sets: trainings that several share count once."""
    costs = [one.costs[name] for one in scores if name in one.costs]
    known = {part: [cost[part] for cost in costs if cost.get(part) is not None] for part in COST_COLUMNS}
    whole = {part: values[0] for part, values in known.items() if values}
    trained = {(cost.get("images"), cost["seconds"]) for cost in costs if cost.get("seconds") is not None}
    if trained:
        whole["seconds"] = sum(seconds for _, seconds in trained)
    if known["embedding_seconds"]:
        whole["embedding_seconds"] = float(np.mean(known["embedding_seconds"]))
    return _cost_cells(whole)


def _cost_cells(cost: Mapping[str, Any]) -> list[Cell]:
    each = cost.get("embedding_seconds")
    shown = {**cost, "embedding_seconds": None if each is None else 1_000 * each}
    return [shown.get(part) for part in COST_COLUMNS]
