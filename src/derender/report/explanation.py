"""The page of an explanation: shares beside controls, maps over images, and whether to trust the maps."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from PIL import Image

from derender.interpretation import Explained, Explanation, tables
from derender.interpretation.attribution import UNCHANGED
from derender.report.charts import INK, SERIES, side_by_side
from derender.report.colours import pictures
from derender.report.page import Page
from derender.report.saliency import draw_maps, safe_name
from derender.storage.atomic import atomic_folder

MARKS = {"shuffled labels": "|", "untrained encoder": "x"}  # in the page's ink: visible on every bar
NAMED, LONGEST_NAME = 6, 24


def write_explanation(
    explained: Explained,
    out: str | Path,
    *,
    sheets: int = 3,
    rows: int = 6,
    progress: Callable[[int, int], object] | None = None,
) -> Explained:
    """Write the folder of an explanation, whole or not at all: page, chart, sheets of maps, and probe.

    ``sheets`` labels get maps, best distinguished first, with so many ``rows`` of images; ``progress`` is
    called with (labels done, labels in all). Returns the explanation with ``checks``: how the maps answer to
    fresh weights.
    """
    drawn, checks = draw_maps(explained, labels=sheets, rows=rows, progress=progress)
    explained = replace(explained, checks=checks)
    svg, png = share_chart(explained.shares)
    with atomic_folder(Path(out)) as folder:
        (folder / "shares.svg").write_text(svg, encoding="utf-8")
        (folder / "shares.png").write_bytes(png)
        for place, (name, made) in enumerate(drawn.items(), 1):
            for method, sheet in made.items():
                sheet.save(folder / f"maps-{place}-{safe_name(name)}-{safe_name(method)}.png")
        explained.shares.probe.save(folder / "probe")
        explanation_page(explained, svg, drawn).write(folder / "explain.html")
    return explained


def explanation_page(
    explained: Explained, chart: str, sheets: Mapping[str, Mapping[str, Image.Image]]
) -> Page:
    """One self-contained page, with the chart as SVG text and sheets of maps by label and method."""
    shares, images, checks = explained.shares, explained.images, explained.checks
    count = len(shares.names)
    asked = ", ".join(shares.names[:NAMED]) + (f" and {count - NAMED} more" if count > NAMED else "")
    if shares.kind == "labels" and count > 1:
        asked = f"{count} yes/no labels"
    pair, faces = explained.pair, []
    if pair is not None:
        rows = [images.files.index(name) for name in pair[0]]
        shown = zip(pictures(images.images[rows]), pair[0], strict=True)
        faces = [(face, f"the image {name}", name) for face, name in shown]
    values = {
        "shares": share_values(shares, chart), "sheets": sheets, "unchanged": UNCHANGED, "tables": tables,
        "checks": checks, "clusters": explained.clusters, "pair": pair, "faces": faces,
    }  # fmt: skip
    lead = f"{explained.model.source or 'a model'} on {images.source}: {asked}."
    return Page("explanation.html", "Which factor made the answer", lead, values)


def share_values(found: Explanation, chart: str) -> dict[str, Any]:
    """What ``templates/shares.html`` shows: verdicts, the chart of the shares (SVG text) and their tables."""
    shown = [tables.share_table(found), tables.drop_table(found)]
    return {"verdicts": tables.share_verdicts(found), "chart": chart, "tables": shown}


def share_chart(found: Explanation) -> tuple[str, bytes]:
    """SVG text for a page, and the same as PNG."""
    model, *controls = found.rows
    places = np.arange(len(found.names))[::-1]
    names = [name if len(name) <= LONGEST_NAME else f"{name[: LONGEST_NAME - 1]}…" for name in found.names]

    def draw(axes: Axes, factor: int) -> None:
        shares = model.shares[:, :, factor]
        share, spread = shares.mean(axis=0), shares.std(axis=0)
        whiskers = np.fmax((share - model.low[:, factor], model.high[:, factor] - share), spread)
        axes.barh(places, share, height=0.7, color=SERIES[factor % len(SERIES)], alpha=0.85)
        axes.errorbar(share, places, xerr=whiskers, fmt="none", ecolor=INK, elinewidth=1)
        for row in controls:
            axes.plot(
                row.shares[:, :, factor].mean(axis=0), places, MARKS[row.name],
                color=INK, markersize=7, markeredgewidth=1.6, label=row.name,
            )  # fmt: skip
        axes.set_yticks(places, names)
        axes.set_ylim(-0.7, len(places) - 0.3)
        axes.tick_params(axis="y", length=0)
        axes.grid(True, axis="x")
        axes.set_axisbelow(True)

    panels = {name: lambda axes, at=at: draw(axes, at) for at, name in enumerate(found.factors)}
    return side_by_side(panels, "share of |IG|", (1.6 + 2.0 * len(panels), 1.3 + 0.24 * len(places)))
