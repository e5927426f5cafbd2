"""Charts as SVG text that takes the colour of the page around it: curves over training, bars with controls.

Text stays text; axes and labels use ``currentColor``, so one chart serves light and dark pages and print.
Leaves out interaction.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from hashlib import sha256
from io import BytesIO, StringIO
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

SERIES = ("#3b82f6", "#f59e0b", "#10b981", "#ec4899", "#8b5cf6", "#64748b")
INK = "#010203"
"""Stands for currentColor until the SVG text is written: the colour of the page's text, light or dark."""
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "derender",
    "font.family": "sans-serif",
    "font.size": 10,
    "text.parse_math": False,  # names of classes and files are no formulas
    "text.color": INK,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "grid.color": INK,
    "grid.alpha": 0.12,
    "grid.linewidth": 0.7,
    "legend.frameon": False,
}


def curves(
    series: Mapping[str, tuple[Sequence[float], Sequence[float]]],
    x_label: str,
    y_label: str,
    levels: Mapping[str, float] | None = None,
    size: tuple[float, float] = (7.2, 2.9),
) -> str:
    """Lines by name, each (x values, y values), and dashed ``levels`` (controls) by name, as SVG text."""
    if not series:
        raise ValueError("a chart needs at least one series")
    with matplotlib.rc_context(_STYLE):
        figure, axes = _axes(size)
        for (name, (x, y)), colour in zip(series.items(), _cycle(len(series)), strict=True):
            axes.plot(x, y, color=colour, linewidth=1.8, label=name, marker="o" if len(x) < 2 else None)
        for name, level in (levels or {}).items():
            axes.axhline(level, color=INK, alpha=0.55, linewidth=1, linestyle=(0, (4, 3)))
            axes.annotate(name, (1, level), xycoords=("axes fraction", "data"), xytext=(-2, 3),
                          textcoords="offset points", ha="right", fontsize=9, alpha=0.75)  # fmt: skip
        axes.set_xlabel(x_label)
        axes.set_ylabel(y_label)
        axes.grid(True)
        axes.margins(x=0.01)
        axes.xaxis.set_major_formatter(FuncFormatter(_spoken))
        if len(series) > 1:
            figure.legend(loc="outside upper left", ncols=min(len(series), 3))  # seen where charts scroll
        return _svg(figure)


def bars(
    values: Mapping[str, float],
    x_label: str,
    highlighted: Sequence[str] = (),
    level: tuple[str, float] | None = None,
) -> str:
    """One bar a name, ``highlighted`` ones in colour, and a dashed ``level`` (chance), as SVG text."""
    if not values:
        raise ValueError("a chart needs at least one bar")
    with matplotlib.rc_context(_STYLE):
        figure, axes = _axes((7.2, 0.6 + 0.34 * len(values)))
        names = list(values)[::-1]
        tints = [SERIES[0] if name in highlighted else "#94a3b8" for name in names]
        drawn = axes.barh(names, [values[name] for name in names], color=tints, height=0.66)
        axes.bar_label(drawn, fmt="%.3g", padding=4, fontsize=9)
        axes.margins(x=0.12)
        if level is not None:
            axes.axvline(level[1], color=INK, alpha=0.6, linewidth=1, linestyle=(0, (4, 3)))
            axes.annotate(level[0], (level[1], 1), xycoords=("data", "axes fraction"), xytext=(0, 2),
                          textcoords="offset points", ha="center", fontsize=9, alpha=0.75)  # fmt: skip
        axes.set_xlabel(x_label)
        axes.tick_params(axis="y", length=0)
        return _svg(figure)


def side_by_side(
    panels: Mapping[str, Callable[[Axes], None]],
    x_label: str,
    size: tuple[float, float],
    columns: int | None = None,
) -> tuple[str, bytes]:
    """Panels by title with one vertical axis, each drawn by its function, as SVG text and as PNG.

    What the first panel labels is explained below them all, in so many columns (by default in one line).
    """
    if not panels:
        raise ValueError("a chart needs at least one panel")
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=size, layout="constrained")
        figure.patch.set_alpha(0)
        drawn = figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)[0]
        for axes, (title, draw) in zip(drawn, panels.items(), strict=True):
            axes.patch.set_alpha(0)
            draw(axes)
            axes.set_title(title, fontsize=10)
            axes.set_xlabel(x_label)
        handles, labels = drawn[0].get_legend_handles_labels()
        if handles:
            figure.legend(handles, labels, loc="outside lower left", ncols=columns or len(handles))
        svg = _svg(figure)
        figure.patch.set(facecolor="white", alpha=1)  # a picture file has no page behind it
        stream = BytesIO()
        figure.savefig(stream, format="png", dpi=150, metadata={"Software": None})
        return svg, stream.getvalue()


def _axes(size: tuple[float, float]) -> tuple[Figure, Axes]:
    figure = Figure(figsize=size, layout="constrained")
    figure.patch.set_alpha(0)
    axes = figure.add_subplot()
    axes.patch.set_alpha(0)
    return figure, axes


def _spoken(value: float, _: int | None = None) -> str:
    """A tick of a count: 10,000, and 0.5 as it is."""
    return f"{value:,.0f}" if float(value).is_integer() else f"{value:g}"


def _cycle(count: int) -> list[str]:
    return [SERIES[index % len(SERIES)] for index in range(count)]


def _svg(figure: Figure) -> str:
    """The figure's SVG element alone: no prologue, no metadata, ids of its own, the page's colour."""
    stream = StringIO()
    figure.savefig(
        stream, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None}
    )
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = text.replace(INK, "currentColor")
    text = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1)
    text = re.sub(r"font: ([\d.]+)px [^;\"]*", r"font-size: \1px", text)
    text = re.sub(r"font-family: [^;\"]*;?", "", text)
    return _own_ids(text)


def _own_ids(svg: str) -> str:
    """Ids of one chart must not meet those of another: keep the referenced ones, with a prefix."""
    prefix = "c" + sha256(svg.encode()).hexdigest()[:8]
    used = set(re.findall(r'(?:url\(#|href="#)([^)"]+)', svg))

    def renamed(match: re.Match[str]) -> str:
        return f' id="{prefix}-{match[1]}"' if match[1] in used else ""

    svg = re.sub(r' id="([^"]+)"', renamed, svg)
    svg = re.sub(r"url\(#", f"url(#{prefix}-", svg)
    return re.sub(r'href="#', f'href="#{prefix}-', svg)
