"""Curves of accuracy over angle: as tables, as a chart, and as one page.

The chart has a panel for each axis; controls are grey and dashed, and shaded is the range that the 95 %
interval of the first features covers. Leaves out computing anything (``derender.evaluation.robust``).
"""

from pathlib import Path

from matplotlib.axes import Axes

from derender.evaluation.robust import CurveResult, RobustnessComparison
from derender.evaluation.robust.compare import AREA, SCORES, level_name
from derender.report import blocks
from derender.report.charts import SERIES, side_by_side
from derender.report.page import Page, Section, write_whole

CONTROL_LINES = ((0, (5, 2)), (0, (1, 1)), (0, (3, 1, 1, 1)), (0, (6, 1, 1, 1, 1, 1)))


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
                axes.set_ylabel(SCORES[score])

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
        f"{SCORES[score].capitalize()} at each angle, after learning in ordinary light and view. Grey: "
        "controls that learned nothing. Shaded: the 95 % interval of the first features."
    )
    sections = [Section("Curves", [blocks.chart(svg, alt, caption)])]
    tables = found.tables(score)
    for at, curve in enumerate(found.curves):
        own = tables[3 * at : 3 * at + 3]
        sections.append(Section(curve.title.capitalize(), [blocks.table(one) for one in own]))
    return Page(
        "Robustness to light and view",
        f"{found.how.capitalize()}: learned in ordinary light and view, asked in others.",
        sections,
        f"Model: {model}. Definitions: docs/evaluation.md.",
    )


def write_curves(found: RobustnessComparison, score: str, model: str, file: Path) -> None:
    """Write the chart (.svg, .png) or the page (.html)."""
    if file.suffix.lower() == ".html":
        robustness_page(found, model, score).write(file)
        return
    svg, png = robustness_chart(found, score)
    write_whole(file, png if file.suffix.lower() == ".png" else svg.encode())
