"""Whether what was measured again and again stayed flat, as a verdict, a table and curves.

The first quarter warms up and is not judged. Something grows if the median of the last quarter exceeds that
of the second by more than its bound, or if the slope between (Theil-Sen) does, surely (its 95 % interval).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.stats import theilslopes

BOUNDS = {
    "private_mb": (20.0, 0.03),
    "resident_mb": (20.0, 0.03),
    "peak_mb": (20.0, 0.03),
    "descriptors": (4.0, 0.0),
    "threads": (2.0, 0.0),
    "children": (0.5, 0.0),
    "files": (2.0, 0.0),
}
"""How much more there may be in the end: so much, or this share of what there was, whichever is larger."""

SAMPLES_AT_LEAST = 8


@dataclass
class Series:
    """One quantity over time: seconds since the load began, and values."""

    seconds: list[float] = field(default_factory=list)
    values: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class Verdict:
    """What became of a quantity after the first quarter.

    Attributes:
        before: median of the second quarter.
        after: median of the last quarter.
        median: of all three quarters.
        largest: of all three quarters.
        slope: change per hour by Theil-Sen.
        low: lower end of its 95 % interval.
        high: upper end.
        grows: whether it grew by more than its bound.
    """

    before: float
    after: float
    median: float
    largest: float
    slope: float
    low: float
    high: float
    grows: bool


def verdict(series: Series, bound: tuple[float, float]) -> Verdict:
    """Whether a series grows by more than the larger of an amount and a share.

    Raises:
        ValueError: too few samples, or none in a quarter.
    """
    hours, found = np.asarray(series.seconds) / 3600, np.asarray(series.values)
    if len(found) < SAMPLES_AT_LEAST:
        raise ValueError(f"{len(found)} samples tell nothing: soak for longer, or sample more often")
    warm, half, late = hours[0] + (hours[-1] - hours[0]) * np.array([0.25, 0.5, 0.75])
    judged, second, last = hours >= warm, (hours >= warm) & (hours < half), hours >= late
    if not second.any():
        raise ValueError("the second quarter has no sample: sample evenly")
    before, after = float(np.median(found[second])), float(np.median(found[last]))
    slope, _, low, high = np.asarray(theilslopes(found[judged], hours[judged], alpha=0.95)).tolist()
    allowed = max(bound[0], bound[1] * before)
    grows = after - before > allowed or low * float(hours[-1] - warm) > allowed
    median, largest = float(np.median(found[judged])), float(found[judged].max())
    return Verdict(before, after, median, largest, slope, low, high, grows)


def markdown(verdicts: Mapping[str, Mapping[str, Verdict]]) -> str:
    """One row for each quantity of each process."""
    lines = [
        "| process | quantity | second quarter | last quarter | median | largest | per hour (95 %) | |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: | --- |",
    ]
    for name, quantities in verdicts.items():
        for quantity, one in quantities.items():
            numbers = (one.before, one.after, one.median, one.largest)
            slope = f"{one.slope:+,.1f} ({one.low:+,.1f} to {one.high:+,.1f})"
            cells = [name, quantity, *(f"{number:,.1f}" for number in numbers), slope]
            lines.append(f"| {' | '.join(cells)} | {'GROWS' if one.grows else 'flat'} |")
    return "\n".join(lines)


def draw(series: Mapping[str, Mapping[str, Series]], panels: Mapping[str, Sequence[str]], file: Path) -> None:
    """Curves over minutes as PNG, one panel for each title, with the quantities it shows."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 2.1 * len(panels)), layout="constrained")
    axes = figure.subplots(len(panels), sharex=True)
    colours = {name: f"C{number}" for number, name in enumerate(series)}
    shown, end = {}, 0.0
    for axis, (title, quantities) in zip(axes, panels.items(), strict=True):
        for name, quantity in ((name, key) for name, found in series.items() for key in found):
            if quantity in quantities:
                one = series[name][quantity]
                minutes = np.asarray(one.seconds) / 60
                marker = "." if quantity == "peak_mb" else ""
                (shown[name],) = axis.plot(
                    minutes, one.values, color=colours[name], linewidth=1, marker=marker, markersize=3
                )
                end = max(end, float(minutes[-1]))
        axis.set_ylabel(title)
        axis.set_ylim(bottom=0)
    for axis in axes:
        axis.axvspan(0, end / 4, color="0.93", linewidth=0, zorder=0)
    axes[-1].set_xlabel("minutes (grey: warm-up, not judged)")
    figure.legend(shown.values(), shown.keys(), loc="outside upper center", ncols=4, frameon=False)
    figure.savefig(file, dpi=110)
