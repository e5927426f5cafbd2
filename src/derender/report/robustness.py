"""Curves of accuracy over angle: as tables, as a chart, and as one page.

The chart has a panel for each axis. Controls are grey and dashed; the 95 % interval of the first features is
shaded. Leaves out computing anything (``derender.evaluation.robust``).
"""

from itertools import cycle
from pathlib import Path

from matplotlib.axes import Axes

from derender.evaluation.robust import CurveResult, RobustnessComparison
from derender.evaluation.robust.compare import AREA, SCORES, level_name
from derender.report.charts import SERIES, side_by_side
from derender.report.page import Page, write_whole

CONTROL_LINES = ((0, (5, 2)), (0, (1, 1)), (0, (3, 1, 1, 1)), (0, (6, 1, 1, 1, 1, 1)))


def robustness_chart(found: RobustnessComparison, score: str = "accuracy") -> tuple[str, bytes]:
    """Every curve, a panel for each axis, as SVG text and as PNG."""

    def draw(axes: Axes, curve: CurveResult) -> None:
        dashes = cycle({"color": "#64748b", "linestyle": line} for line in CONTROL_LINES)
        colours = cycle({"color": colour, "marker": "o", "markersize": 3} for colour in SERIES[:-1])
        for row in curve.rows[score]:
            style = next(dashes if row.control else colours)
            axes.plot(curve.levels, curve.values(row), label=row.name, linewidth=1.6, **style)
        first = next((row for row in curve.rows[score] if not row.control), None)
        if first is not None:
            ends = [first.scores[level_name(level)] for level in curve.levels]
            low, high = [one.low for one in ends], [one.high for one in ends]
            axes.fill_between(curve.levels, low, high, color=SERIES[0], alpha=0.15, linewidth=0)
        axes.set_ylim(0, 1)
        if len({one.levels for one in found.curves}) == 1:  # panels share their ticks
            axes.set_xticks(curve.levels)
        axes.grid(True)
        if curve is found.curves[0]:
            axes.set_ylabel(SCORES[score])

    panels = {curve.title: lambda axes, curve=curve: draw(axes, curve) for curve in found.curves}
    return side_by_side(panels, "degrees off the front", (1.2 + 3.6 * max(2, len(panels)), 3.9), columns=5)


def robustness_page(found: RobustnessComparison, model: str, score: str = "accuracy") -> Page:
    """Chart and tables on one page."""
    areas = [
        f"{curve.title}: {row.name} has the area {row.scores[AREA].value:.3f}"
        for curve in found.curves
        for row in curve.rows[score]
    ]
    tables = found.tables(score)
    own = {curve.title: tables[3 * at : 3 * at + 3] for at, curve in enumerate(found.curves)}
    chart, score_name = robustness_chart(found, score)[0], SCORES[score].capitalize()
    return Page(
        "robustness.html",
        "Robustness to light and view",
        f"{found.how.capitalize()}: learned in ordinary light and view, asked in others.",
        {"chart": chart, "alt": "; ".join(areas), "score": score_name, "tables": own},
        f"Model: {model}. Definitions: docs/reference/metrics.md.",
    )


def write_curves(found: RobustnessComparison, score: str, model: str, file: Path) -> None:
    """Write the chart (.svg, .png) or the page (.html)."""
    if file.suffix.lower() == ".html":
        robustness_page(found, model, score).write(file)
        return
    svg, png = robustness_chart(found, score)
    write_whole(file, png if file.suffix.lower() == ".png" else svg.encode())
