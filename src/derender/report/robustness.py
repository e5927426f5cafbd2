"""Curves of accuracy over angle: as tables, as a chart, and as one page.

The chart has a panel for each axis; controls are grey and dashed, and shaded is the range that the 95 %
interval of the first features covers. Leaves out computing anything (``derender.evaluation.robustness``).
"""

from collections.abc import Callable

from matplotlib.axes import Axes

from derender.evaluation.bootstrap import ScoredRow
from derender.evaluation.robustness import CurveResult, RobustnessComparison
from derender.evaluation.robustness.compare import AREA, ORDINARY, level_name
from derender.evaluation.score_table import Cell, Column, Row, ScoreTable, scored_table, verdict_table
from derender.report import blocks
from derender.report.charts import SERIES, side_by_side
from derender.report.page import Page, Section

SCORE_NAMES = {"accuracy": "accuracy", "balanced_accuracy": "balanced accuracy"}
CONTROL_LINES = ((0, (5, 2)), (0, (1, 1)), (0, (3, 1, 1, 1)), (0, (6, 1, 1, 1, 1, 1)))
AREA_NOTE = "mean height of the curve over the angles, 0 to 1, best 1"


def robustness_tables(found: RobustnessComparison, score: str = "accuracy") -> list[ScoreTable]:
    """For every axis the area and what it is made of, the curve itself, and who is above the controls."""
    tables = []
    for curve in found.curves:
        rows = curve.rows[score]
        tables += [
            area_table(found, curve, score),
            curve_table(curve, score),
            verdict_table(
                rows,
                {AREA: Column("area"), ORDINARY: Column("ordinary")},
                f"{curve.title}: above the strongest control?",
            ),
        ]
    return tables


def area_table(found: RobustnessComparison, curve: CurveResult, score: str) -> ScoreTable:
    """One row for each feature and control: the area, in ordinary light and view, and at the last angle."""
    last = curve.levels[-1]
    at_last = level_name(last)
    columns = {
        AREA: Column("area", "high", note=AREA_NOTE),
        ORDINARY: Column(
            "ordinary", "high", note="other pictures in the light and view of those learned from"
        ),
        at_last: Column(f"at {last:.0f} deg", "high", note="the curve's last point"),
    }
    lost = Column(
        "lost", None, note="ordinary less area; read it beside ordinary, who knows nothing loses none"
    )
    more: dict[Column, Callable[[ScoredRow], Cell]] = {
        lost: lambda row: row.scores[ORDINARY].value - row.scores[AREA].value
    }
    caption = (
        f"{curve.title}, {curve.levels[0]:.0f} to {last:.0f} degrees: {SCORE_NAMES[score]} of "
        f"{_asked(found)}, {found.how}; {found.head} probes on {found.n_learned[curve.name]:,} pictures, "
        f"{curve.n_tested[0]:,} to {max(curve.n_tested):,} tested, {len(found.seeds)} seeds"
    )
    if found.n_dropped:
        caption += f"; {found.n_dropped:,} pictures without label left out"
    return scored_table(caption, "features", curve.rows[score], columns, more=more)


def curve_table(curve: CurveResult, score: str) -> ScoreTable:
    """The curve in numbers: a column for each angle."""
    columns = [Column(f"{level:.0f}", "high") for level in curve.levels]
    rows = [Row(row.name, curve.values(row), row.control) for row in curve.rows[score]]
    return ScoreTable(f"{curve.title} in degrees: {SCORE_NAMES[score]}", "features", columns, rows)


def robustness_chart(found: RobustnessComparison, score: str = "accuracy") -> tuple[str, bytes]:
    """Every curve, a panel for each axis, as SVG text and as PNG."""

    def panel(curve: CurveResult):
        def draw(axes: Axes) -> None:
            features = quiet = 0
            for row in curve.rows[score]:
                if row.control:
                    style = {"color": "#64748b", "linestyle": CONTROL_LINES[quiet % len(CONTROL_LINES)]}
                    quiet += 1
                else:
                    style = {"color": SERIES[features % (len(SERIES) - 1)], "marker": "o", "markersize": 3}
                    features += 1
                axes.plot(curve.levels, curve.values(row), label=row.name, linewidth=1.6, **style)
                if features == 1 and not row.control:
                    ends = [row.scores[level_name(level)] for level in curve.levels]
                    axes.fill_between(
                        curve.levels,
                        [one.low for one in ends],
                        [one.high for one in ends],
                        color=SERIES[0],
                        alpha=0.15,
                        linewidth=0,
                    )
            axes.set_ylim(0, 1)
            if len({one.levels for one in found.curves}) == 1:  # panels share their ticks
                axes.set_xticks(curve.levels)
            axes.grid(True)
            if curve is found.curves[0]:
                axes.set_ylabel(SCORE_NAMES[score])

        return draw

    panels = {curve.title: panel(curve) for curve in found.curves}
    return side_by_side(panels, "degrees off the front", (1.2 + 3.6 * max(2, len(panels)), 3.9), columns=5)


def robustness_page(found: RobustnessComparison, model: str, score: str = "accuracy") -> Page:
    """Chart and tables on one page."""
    svg, _ = robustness_chart(found, score)
    alt = "; ".join(
        f"{curve.title}: {row.name} has the area {row.scores[AREA].value:.3f}"
        for curve in found.curves
        for row in curve.rows[score]
    )
    caption = (
        f"{SCORE_NAMES[score].capitalize()} at each angle, after learning in ordinary light and view. Grey: "
        "controls that learned nothing. Shaded: the 95 % interval of the first features."
    )
    sections = [Section("Curves", [blocks.chart(svg, alt, caption)])]
    tables = robustness_tables(found, score)
    for at, curve in enumerate(found.curves):
        own = tables[3 * at : 3 * at + 3]
        sections.append(Section(curve.title.capitalize(), [blocks.table(one) for one in own]))
    return Page(
        "Robustness to light and view",
        f"{found.how.capitalize()}: learned in ordinary light and view, asked in others.",
        sections,
        f"Model: {model}. Definitions: docs/evaluation.md.",
    )


def _asked(found: RobustnessComparison) -> str:
    if found.kind == "classes":
        return f"{len(found.names)} classes"
    return found.names[0] if len(found.names) == 1 else f"{len(found.names)} yes/no labels"
