"""What a process and all that it started hold just now, from /proc of Linux; and whether that stayed flat.

The first quarter of a series warms up and is not judged. Something grows if the median of the last quarter
exceeds that of the second by more than its bound, or if the slope between (Theil-Sen) does, surely (its 95 %
interval).
"""

import os
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
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


def processes() -> dict[int, tuple[str, int, int]]:
    """State, parent and group of every process, by number."""
    found = {}
    for file in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):  # it has ended meanwhile
            state, parent, group = file.read_text().rpartition(")")[2].split()[:3]
            found[int(file.parent.name)] = state, int(parent), int(group)
    return found


def of_group(group: int) -> list[int]:
    """Processes of the group that a process leads, whoever their parent is now; zombies left out."""
    return [number for number, (state, _, own) in processes().items() if own == group and state != "Z"]


def measured(root: int) -> dict[str, float]:
    """Of a process and its descendants: MB allocated (private), MB with mapped files (resident), counts."""
    numbers, known = [root], processes()
    for number in numbers:
        numbers += [child for child, (_, parent, _) in known.items() if parent == number]
    total = dict.fromkeys(("private_mb", "resident_mb", "descriptors", "threads"), 0.0)
    for place in (Path(f"/proc/{number}") for number in numbers):
        with suppress(OSError):
            rollup, status = (place / "smaps_rollup").read_text(), (place / "status").read_text()
            kib = dict(re.findall(r"^(\w+):\s+(\d+)", rollup + status, re.MULTILINE))
            total["private_mb"] += int(kib["Anonymous"]) / 1024
            total["resident_mb"] += int(kib["Rss"]) / 1024
            total["descriptors"] += len(list((place / "fd").iterdir()))
            total["threads"] += int(kib["Threads"])
    return {**total, "children": float(len(numbers) - 1)}


def files_below(folder: Path, without: str = "") -> list[str]:
    """Files below a folder, by their path in it; but for those in folders of one name."""
    found = []
    for place, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if name != without]
        found += [str((Path(place) / name).relative_to(folder)) for name in names]
    return sorted(found)


@dataclass(frozen=True)
class Verdict:
    """What became of a quantity after the first quarter.

    Attributes:
        before, after: medians of the second and the last quarter.
        median, largest: of all three quarters.
        slope, low, high: change per hour by Theil-Sen, and its 95 % interval.
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


def verdict(series: Sequence[tuple[float, float]], bound: tuple[float, float]) -> Verdict:
    """Whether pairs of seconds and value grow by more than the larger of an amount and a share.

    Raises:
        ValueError: too few samples.
    """
    if len(series) < SAMPLES_AT_LEAST:
        raise ValueError(f"{len(series)} samples tell nothing: soak for longer, or sample more often")
    seconds, values = np.asarray(series).T
    hours = (seconds - seconds[0]) / 3600
    judged, early, late = (hours >= share * hours[-1] for share in (0.25, 0.5, 0.75))
    before, after = float(np.median(values[judged & ~early])), float(np.median(values[late]))
    slope, _, low, high = np.asarray(theilslopes(values[judged], hours[judged], alpha=0.95)).tolist()
    allowed = max(bound[0], bound[1] * before)
    grows = after - before > allowed or low * 0.75 * float(hours[-1]) > allowed
    median, largest = float(np.median(values[judged])), float(values[judged].max())
    return Verdict(before, after, median, largest, slope, low, high, grows)


def markdown(verdicts: Mapping[str, Mapping[str, Verdict]]) -> str:
    """One row for each quantity of each process."""
    lines = [
        "| process | quantity | second quarter | last quarter | median | largest | per hour (95 %) | |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: | --- |",
    ]
    for name, quantities in verdicts.items():
        for quantity, one in quantities.items():
            numbers = (f"{value:,.1f}" for value in (one.before, one.after, one.median, one.largest))
            slope = f"{one.slope:+,.1f} ({one.low:+,.1f} to {one.high:+,.1f})"
            end = "GROWS" if one.grows else "flat"
            lines.append(f"| {' | '.join([name, quantity, *numbers, slope, end])} |")
    return "\n".join(lines)
