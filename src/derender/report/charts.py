"""Charts as SVG text that takes the colour of the page around it: curves over training, bars with controls.

Text stays text; axes and labels use ``currentColor``, so one chart serves light and dark pages and print.
Leaves out interaction.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from hashlib import sha256
from io import BytesIO, StringIO
from itertools import cycle
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

SERIES = ("#3b82f6", "#f59e0b", "#10b981", "#ec4899", "#8b5cf6", "#64748b")
CONTROL_COLOUR = "#94a3b8"
INK = "#010203"
"""Becomes currentColor when the SVG text is written: the colour of the page's text, light or dark."""
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "derender",
    "font.family": "sans-serif",
    "font.size": 10,
    "text.parse_math": False,  # names of classes and files are no formulas
    **dict.fromkeys(
        ("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color", "grid.color"), INK
    ),
    **dict.fromkeys(("axes.spines.top", "axes.spines.right", "legend.frameon"), False),
    **dict.fromkeys(("axes.linewidth", "xtick.major.width", "ytick.major.width"), 0.6),
    "grid.alpha": 0.12,
    "grid.linewidth": 0.7,
}
Draw = Callable[[Axes], object]


def curves(series: Mapping[str, tuple[Sequence[float], Sequence[float]]], x_label: str, y_label: str) -> str:
    """Lines by name, each (x values, y values), as SVG text."""
    if not series:
        raise ValueError("a chart needs at least one series")

    def draw(axes: Axes) -> None:
        for (name, (x, y)), colour in zip(series.items(), cycle(SERIES), strict=False):
            marker, label = "o" if len(x) < 2 else None, name if len(series) > 1 else None
            axes.plot(x, y, color=colour, linewidth=1.8, label=label, marker=marker)
        axes.set_ylabel(y_label)
        axes.grid(True)
        axes.margins(x=0.01)
        axes.xaxis.set_major_formatter(
            FuncFormatter(lambda value, _: f"{value:,.0f}" if float(value).is_integer() else f"{value:g}")
        )

    legend = {"loc": "outside upper left", "ncols": min(len(series), 3)}  # seen where charts scroll
    return _drawn({"": draw}, x_label, (7.2, 2.9), legend)[0]


def bars(
    values: Mapping[str, float],
    x_label: str,
    highlighted: Sequence[str] = (),
    level: tuple[str, float] | None = None,
) -> str:
    """One bar a name, ``highlighted`` ones in colour, and a dashed ``level`` (chance), as SVG text."""
    names = list(values)[::-1]

    def draw(axes: Axes) -> None:
        tints = [SERIES[0] if name in highlighted else CONTROL_COLOUR for name in names]
        drawn = axes.barh(names, [values[name] for name in names], color=tints, height=0.66)
        axes.bar_label(drawn, fmt="%.3g", padding=4, fontsize=9)
        axes.margins(x=0.12)
        if level is not None:
            axes.axvline(level[1], color=INK, alpha=0.6, linewidth=1, linestyle=(0, (4, 3)))
            axes.annotate(level[0], (level[1], 1), xycoords=("data", "axes fraction"), xytext=(0, 2),
                          textcoords="offset points", ha="center", fontsize=9, alpha=0.75)  # fmt: skip
        axes.tick_params(axis="y", length=0)

    return _drawn({"": draw}, x_label, (7.2, 0.6 + 0.34 * len(values)), {})[0]


def side_by_side(
    panels: Mapping[str, Draw], x_label: str, size: tuple[float, float], columns: int | None = None
) -> tuple[str, bytes]:
    """Panels by title with one vertical axis, each drawn by its function, as SVG text and as PNG.

    A legend of the first panel's labels lies below them all, in so many columns (by default in one line).
    """
    if not panels:
        raise ValueError("a chart needs at least one panel")
    return _drawn(panels, x_label, size, {"loc": "outside lower left", "ncols": columns or 99})


@matplotlib.rc_context(_STYLE)
def _drawn(
    panels: Mapping[str, Draw], x_label: str, size: tuple[float, float], legend: dict[str, Any]
) -> tuple[str, bytes]:
    """SVG text on a transparent ground, and PNG on white."""
    figure = Figure(figsize=size, layout="constrained")
    drawn = list(figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)[0])
    for axes, (title, draw) in zip(drawn, panels.items(), strict=True):
        draw(axes)
        axes.set_title(title, fontsize=10)
        axes.set_xlabel(x_label)
        axes.patch.set_alpha(0)
    handles, labels = drawn[0].get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, **{**legend, "ncols": min(legend["ncols"], len(handles))})
    figure.patch.set_alpha(0)
    svg = _svg(figure)
    figure.patch.set(facecolor="white", alpha=1)  # an image file has no page behind it
    stream = BytesIO()
    figure.savefig(stream, format="png", dpi=150, metadata={"Software": None})
    return svg, stream.getvalue()


def _svg(figure: Figure) -> str:
    """The figure's SVG element alone: no prologue, no metadata, ids of its own, the page's colour."""
    stream = StringIO()
    figure.savefig(stream, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    text = stream.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = text.replace(INK, "currentColor")
    for name in ("width", "height"):
        text = re.sub(rf'(<svg[^>]*?) {name}="[^"]*"', r"\1", text, count=1)
    text = re.sub(r"font: ([\d.]+)px [^;\"]*", r"font-size: \1px", text)
    text = re.sub(r"font-family: [^;\"]*;?", "", text)
    prefix = "c" + sha256(text.encode()).hexdigest()[:8]  # ids of one chart must not meet those of another
    used = set(re.findall(r'(?:url\(#|href="#)([^)"]+)', text))
    text = re.sub(
        r' id="([^"]+)"', lambda match: f' id="{prefix}-{match[1]}"' if match[1] in used else "", text
    )
    return text.replace("url(#", f"url(#{prefix}-").replace('href="#', f'href="#{prefix}-')
