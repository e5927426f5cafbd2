"""Shares of factors as a chart: a panel for each factor, a bar for each label, controls as marks.

Whiskers are the 95 % interval over pictures, or the spread over seeds where that is wider.
"""

import numpy as np
from matplotlib.axes import Axes

from derender.interpretation import Explanation
from derender.report.charts import INK, SERIES, side_by_side

MARKS = {
    "shuffled labels": "|",
    "untrained encoder": "x",
}  # in the page's ink: seen on every bar, light or dark


def share_chart(found: Explanation) -> tuple[str, bytes]:
    """SVG text for a page, and the same as PNG."""
    model, *controls = found.rows
    places = np.arange(len(found.names))[::-1]

    def panel(factor: int):
        def draw(axes: Axes) -> None:
            share = _mean(model.shares)[:, factor]
            spread = model.shares[:, :, factor].std(axis=0)
            below = np.fmax(share - model.low[:, factor], spread)
            above = np.fmax(model.high[:, factor] - share, spread)
            axes.barh(places, share, height=0.7, color=SERIES[factor % len(SERIES)], alpha=0.85)
            axes.errorbar(share, places, xerr=np.stack((below, above)), fmt="none", ecolor=INK, elinewidth=1)
            for row in controls:
                axes.plot(
                    _mean(row.shares)[:, factor], places, MARKS[row.name],
                    color=INK, markersize=7, markeredgewidth=1.6, label=row.name,
                )  # fmt: skip
            axes.set_yticks(places, [_short(name) for name in found.names])
            axes.set_ylim(-0.7, len(places) - 0.3)
            axes.tick_params(axis="y", length=0)
            axes.grid(True, axis="x")
            axes.set_axisbelow(True)

        return draw

    panels = {name: panel(factor) for factor, name in enumerate(found.factors)}
    return side_by_side(panels, "share of |IG|", (1.6 + 2.0 * len(panels), 1.3 + 0.24 * len(places)))


def _mean(values: np.ndarray) -> np.ndarray:
    """Over seeds; NaN where one has none."""
    return values.mean(axis=0)


def _short(name: str) -> str:
    return name if len(name) <= 24 else name[:23] + "…"
