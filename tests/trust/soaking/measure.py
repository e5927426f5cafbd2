"""What a process and all that it started hold just now: memory, descriptors, threads, from /proc of Linux."""

import os
import re
from pathlib import Path

PROC = Path("/proc")


def measured(root: int) -> dict[str, float]:
    """Of a process and its descendants together.

    private_mb is what they allocated (Anonymous); resident_mb has files that are mapped, too, libraries most
    of all; pss_mb shares those out among processes, and uss_mb leaves out what others map.
    """
    total = dict.fromkeys(("private_mb", "resident_mb", "pss_mb", "uss_mb", "descriptors", "threads"), 0.0)
    numbers = descendants(root)
    for number in numbers:
        place = PROC / str(number)
        try:
            rollup = place.joinpath("smaps_rollup").read_text()
            status = place.joinpath("status").read_text()
            descriptors = len(list((place / "fd").iterdir()))
        except OSError:  # it has ended meanwhile
            continue
        kib = {name: int(value) for name, value in re.findall(r"^(\w+):\s+(\d+) kB", rollup, re.MULTILINE)}
        total["private_mb"] += kib["Anonymous"] / 1024
        total["resident_mb"] += kib["Rss"] / 1024
        total["pss_mb"] += kib["Pss"] / 1024
        total["uss_mb"] += (kib["Private_Clean"] + kib["Private_Dirty"]) / 1024
        total["descriptors"] += descriptors
        total["threads"] += int(status.partition("Threads:")[2].split()[0])
    return {**total, "children": float(len(numbers) - 1)}


def descendants(root: int) -> list[int]:
    """A process, its children, their children and so on."""
    children: dict[int, list[int]] = {}
    for number, _, parent, _ in _processes():
        children.setdefault(parent, []).append(number)
    found = [root]
    for number in found:
        found += children.get(number, [])
    return found


def of_group(group: int) -> list[int]:
    """Processes of the group that a process leads, whoever their parent is now; zombies left out."""
    return [number for number, state, _, own in _processes() if own == group and state != "Z"]


def files_below(folder: Path, without: str = "") -> list[str]:
    """Files below a folder, by their path in it; but for those in folders of one name."""
    found = []
    for place, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if name != without]
        found += [os.path.relpath(os.path.join(place, name), folder) for name in names]  # noqa: PTH118
    return sorted(found)


def _processes() -> list[tuple[int, str, int, int]]:
    """Number, state, parent and group of every process."""
    found = []
    for place in PROC.iterdir():
        if place.name.isdigit():
            try:
                words = (place / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            found.append((int(place.name), words[0], int(words[1]), int(words[2])))
    return found
