"""Many methods on many data sets: one table and one image for each protocol, with what every row cost.

Rows are methods and controls, columns data sets. Under the one table each data set has its own, with every
score, its interval and the row's cost. What failed or is missing says so in its place. Leaves out computing
(``derender.cli.plan``).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import isfinite
from textwrap import shorten
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from derender.evaluation.bootstrap import Difference, Estimate, ScoredRow
from derender.evaluation.clustering import about_clustering
from derender.evaluation.clustering_scores import CLUSTER_COLUMNS
from derender.evaluation.linear_probing import LINEAR_COLUMNS, PROBE_NAMES
from derender.evaluation.score_table import (
    Cell,
    Column,
    Row,
    ScoreTable,
    scored_table,
    verdict_table,
)
from derender.report.charts import SERIES, side_by_side

LONGEST_REASON = 60  # characters of it in a cell; the page and the Markdown say it whole
CONTROL_COLOUR = "#94a3b8"
SUMMARY_HEAD = "logistic"  # the head of the linear protocol that the one table shows


@dataclass(frozen=True)
class Cost:
    """What a row cost on one data set; None where there is nothing to tell.

    Attributes:
        parameters: of all its networks.
        seconds: of training, resumed parts included; mean over seeds.
        images: images seen in it, repeats counted.
        numbers: that describe an image.
        embedding_seconds: for one image.
    """

    parameters: int | None = None
    seconds: float | None = None
    images: int | None = None
    numbers: int | None = None
    embedding_seconds: float | None = None


@dataclass(frozen=True)
class ScoredQuestion:
    """One question under one protocol (and one head at one number of labels, for the linear one).

    Attributes:
        name: of the data set, and of the question if it has several.
        protocol: "cluster" or "linear".
        about: rows, classes and the like, in words.
        rows: methods and controls.
        costs: by row.
        absent: by method, why it is not among the rows.
        head, count: of the linear protocol.
    """

    name: str
    protocol: str
    about: str
    rows: Sequence[ScoredRow]
    costs: Mapping[str, Cost] = field(default_factory=dict)
    absent: Mapping[str, str] = field(default_factory=dict)
    head: str = ""
    count: int = 0

    @property
    def columns(self) -> Mapping[str, Column]:
        """The protocol's scores."""
        return CLUSTER_COLUMNS if self.protocol == "cluster" else LINEAR_COLUMNS


COST_COLUMNS = (
    Column("numbers", None, note="that describe an image"),
    Column("parameters", None, note="of all networks that were trained"),
    Column("images seen", None, note="in training, repeats counted"),
    Column("training, s", None, 0, note="wall time of the training loop, whatever else the machine did"),
    Column("ms an image", None, 2, note="to embed, likewise"),
)


def scores_from(
    question: Mapping[str, Any], costs: Mapping[str, Cost], absent: Mapping[str, str]
) -> list[ScoredQuestion]:
    """The scores of a question as JSON keeps them: one of clusters, or one for each head and count."""
    name, how = str(question["name"]), (costs, absent)
    if question["protocol"] == "cluster":
        about = about_clustering(question["method"], question["n_rows"], question["labels"])
        return [ScoredQuestion(name, "cluster", about, rows_from(question["rows"]), *how)]
    kind = "classes" if question["kind"] == "classes" else "yes/no labels"
    about = f"{question['n_test']:,} tested, {len(question['names'])} {kind}, {len(question['seeds'])} seeds"
    return [
        ScoredQuestion(
            name, "linear", f"{PROBE_NAMES.get(head, head)}, {count:,} labelled rows, {about}",
            rows_from(part["rows"]), *how, head, count,
        )
        for part in question["parts"]
        for head, count in [(part["head"], part["labels"])]
    ]  # fmt: skip


def rows_from(values: Mapping[str, Any]) -> list[ScoredRow]:
    """Rows as JSON keeps them: without resamples, null for NaN."""

    def numbers(one: Mapping[str, Any]) -> dict[str, Any]:
        named = {"deviation" if part == "spread" else part: value for part, value in one.items()}
        return {part: float("nan") if value is None else value for part, value in named.items()}

    return [
        ScoredRow(
            name, row["control"], row["runs"],
            {score: Estimate(**numbers(one), resampled=np.empty(0)) for score, one in row["scores"].items()},
            {score: Difference(**numbers(one)) for score, one in row["versus"].items()},
        )
        for name, row in values.items()
    ]  # fmt: skip


def protocol_table(scores: Sequence[ScoredQuestion], methods: Sequence[str]) -> ScoreTable:
    """The one table: a row for each method and control, the main scores of each data set, and the cost.

    Args:
        scores: of one protocol; of the linear one those with ``SUMMARY_HEAD`` are shown.
        methods: in order; controls come after them.
    """
    shown = _shown(scores)
    protocol = shown[0].protocol
    main = ("accuracy", "nmi") if protocol == "cluster" else ("balanced_accuracy",)
    columns: list[Column] = []
    for one in shown:
        head = f"{one.name}, {one.count:,} labels" if one.count else one.name
        columns.append(Column(f"{head}: {one.columns[main[0]].name}", "high", note=one.about))
        columns += [Column(one.columns[name].name, "high") for name in main[1:]]
    by_name = [{row.name: row for row in one.rows} for one in shown]
    rows = []
    for name in dict.fromkeys((*methods, *(name for found in by_name for name in found))):
        cells: list[Cell] = []
        for one, found in zip(shown, by_name, strict=True):
            word = one.absent[name].partition(":")[0] if name in one.absent else None
            missing = (word, *(None for _ in main[1:]))
            cells += [found[name].scores[score].value for score in main] if name in found else missing
        control = any(found[name].control for found in by_name if name in found)
        rows.append(Row(name, (*cells, *_cells(_together(shown, name))), control))
    caption = "Clustering" if protocol == "cluster" else f"Few labels, {PROBE_NAMES[shown[0].head]}"
    caption += ": all data sets; training time is the sum over training sets"
    return ScoreTable(caption, "features", (*columns, *COST_COLUMNS), rows)


def set_tables(one: ScoredQuestion, methods: Sequence[str]) -> list[ScoreTable]:
    """One data set's own table, with every score, interval and cost, and who is above the controls."""
    costs: dict[Column, Callable[[ScoredRow], Cell]] = {
        column: lambda row, place=place: _cells(one.costs.get(row.name, Cost()))[place]
        for place, column in enumerate(COST_COLUMNS)
    }
    table = scored_table(f"{one.name}: {one.about}", "features", one.rows, one.columns, more=costs)
    found = {row.name: row for row in table.rows}
    blank = [None] * (len(table.columns) - 1 - len(COST_COLUMNS))
    for name in one.absent.keys() - found.keys():
        why = shorten(one.absent[name], LONGEST_REASON, placeholder=" ...")
        found[name] = Row(name, (why, *blank, *_cells(one.costs.get(name, Cost()))))
    order = dict.fromkeys((*methods, *(row.name for row in table.rows)))
    verdict = verdict_table(one.rows, one.columns, f"{one.name}, above the strongest control? {one.about}")
    return [replace(table, rows=[found[name] for name in order if name in found]), verdict]


def protocol_picture(scores: Sequence[ScoredQuestion], methods: Sequence[str]) -> tuple[str, bytes]:
    """A panel of bars for each data set, methods in colour, controls grey, as SVG text and as PNG.

    Whiskers are 95 % intervals. Of the linear protocol the largest number of labels is shown.
    """
    shown = _shown(scores)
    if shown[0].protocol == "linear":
        most = {one.name: max(other.count for other in shown if other.name == one.name) for one in shown}
        shown = [one for one in shown if one.count == most[one.name]]
    score = "accuracy" if shown[0].protocol == "cluster" else "balanced_accuracy"
    every = list(dict.fromkeys((*methods, *(row.name for one in shown for row in one.rows))))
    panels = {
        f"{one.name}, {one.count:,} labels" if one.count else one.name: _panel(one, every, score)
        for one in shown
    }
    size = (max(7.2, 1.6 + 2.1 * len(panels)), 0.9 + 0.3 * len(every))
    return side_by_side(panels, score.replace("_", " "), size)


def _panel(one: ScoredQuestion, names: Sequence[str], score: str) -> Any:
    found = {row.name: row for row in one.rows}

    def draw(axes: Axes) -> None:
        for place, name in enumerate(reversed(names)):
            row = found.get(name)
            if row is None:
                why = one.absent[name].partition(":")[0] if name in one.absent else ""
                axes.barh(name, 0)
                axes.annotate(why, (0, place), xytext=(3, 0), textcoords="offset points", va="center",
                              fontsize=8, alpha=0.75)  # fmt: skip
                continue
            estimate = row.scores[score]
            axes.barh(name, estimate.value, color=CONTROL_COLOUR if row.control else SERIES[0], height=0.66)
            if isfinite(estimate.low):
                axes.plot(
                    [estimate.low, estimate.high], [name, name], color="#010203", alpha=0.6, linewidth=1
                )
        axes.tick_params(axis="y", length=0)
        axes.grid(True, axis="x")
        axes.set_axisbelow(True)

    return draw


def _shown(scores: Sequence[ScoredQuestion]) -> list[ScoredQuestion]:
    """What the one table and the image show."""
    if not scores:
        raise ValueError("there is nothing to show: no data set was scored")
    heads = [one.head for one in scores]
    head = SUMMARY_HEAD if SUMMARY_HEAD in heads else heads[0]
    return [one for one in scores if one.head == head]


def _together(scores: Sequence[ScoredQuestion], name: str) -> Cost:
    """A method's cost over several data sets: trainings that several share count once."""
    costs = [one.costs[name] for one in scores if name in one.costs]
    trained = {(cost.seconds, cost.images) for cost in costs if cost.seconds is not None}
    embedding = [cost.embedding_seconds for cost in costs if cost.embedding_seconds is not None]

    def first(field: str) -> int | None:
        return next((value for cost in costs if (value := getattr(cost, field)) is not None), None)

    return Cost(
        first("parameters"), sum(seconds for seconds, _ in trained) if trained else None, first("images"),
        first("numbers"), float(np.mean(embedding)) if embedding else None,
    )  # fmt: skip


def _cells(cost: Cost) -> tuple[Cell, ...]:
    each = None if cost.embedding_seconds is None else 1_000 * cost.embedding_seconds
    return (cost.numbers, cost.parameters, cost.images, cost.seconds, each)
