"""The page of an explanation: shares beside controls, maps over images, and whether to trust the maps."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from PIL import Image

import derender
from derender.interpretation import Explained, Explanation
from derender.interpretation.attribution import UNCHANGED, Similarity
from derender.interpretation.tables import (
    cluster_share_table,
    drop_table,
    pair_table,
    sanity_table,
    share_table,
    share_verdicts,
    unasked,
    untrusted,
)
from derender.report import blocks
from derender.report.blocks import Html
from derender.report.charts import INK, SERIES, side_by_side
from derender.report.page import Page, Section
from derender.report.saliency import draw_maps, safe_name
from derender.storage.atomic import atomic_folder

MARKS = {"shuffled labels": "|", "untrained encoder": "x"}  # in the page's ink: visible on every bar
METHOD_MEANING = {
    "grad-cam": "Grad-CAM at the encoder's last spatial convolution (4 x 4 places): the paper's. It averages "
    "the gradient over places and can light up where the answer does not look.",
    "hires-cam": "Gradient times feature place by place, at the same convolution: what lights up was used.",
    "pixels": "Integrated gradients of the pixels through the whole encoder, from a grey image, absolute "
    "and slightly smoothed.",
    "fresh weights": "Grad-CAM of the same networks with weights drawn anew and the same probe: a map "
    "without learning. The shares are those of the fresh networks.",
    "feature": "Grad-CAM of the factor's own feature (half its squared length), without a question.",
}


NAMED, PAIR_WIDTH = 6, 160
CLUSTERS = (
    "Ward clusters of the features above. The squared distance between a cluster's mean and that of all "
    "other images is the sum of its parts by factor, exactly. Parts depend on how large a factor's features "
    "are; the ratio of variances does not."
)
PAIRS = (
    "The squared distance and the cosine of two images' features are sums of parts by factor, exactly; "
    "parts depend on how large a factor's features are. Two numbers do not: the cosine of each factor alone, "
    "and the share of random pairs that lie farther apart in it (alike; 1: all of them)."
)


def write_explanation(
    explained: Explained,
    out: str | Path,
    *,
    sheets: int = 3,
    rows: int = 6,
    progress: Callable[[int, int], object] | None = None,
) -> Explained:
    """Write the folder of an explanation, whole or not at all: page, chart, sheets of maps, and probe.

    Args:
        explained: of `derender.explain`.
        out: the folder.
        sheets: labels to draw maps for, best distinguished first.
        rows: images on a sheet.
        progress: called with (labels done, labels in all).

    Returns:
        the explanation with ``checks``: how the maps answer to fresh weights.
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
    shares = explained.shares
    sections = [Section("Which factor answers", share_blocks(shares, chart), "Shares")]
    if sheets:
        sections.append(Section("Where it was seen", _sheets(sheets), "Maps"))
    if explained.checks:
        sections.append(Section("Whether the maps can be trusted", _checks(explained.checks), "Sanity"))
    groups: list[Html] = []
    if explained.clusters is not None:
        groups += [blocks.prose(CLUSTERS), blocks.table(cluster_share_table(explained.clusters))]
    groups += _pair(explained)
    if groups:
        sections.append(Section("What groups images", groups, "Groups"))
    count = len(shares.names)
    more = f" and {count - NAMED} more" if count > NAMED else ""
    every = shares.kind == "labels" and count > 1
    asked = f"{count} yes/no labels" if every else ", ".join(shares.names[:NAMED]) + more
    source = explained.model.source or "a model"
    return Page(
        "Which factor made the answer",
        f"{source} on {explained.images.source}: {asked}.",
        sections,
        f"derender {derender.__version__}",
    )


def share_blocks(found: Explanation, chart: str) -> list[Html]:
    """Verdicts, the chart of the shares (SVG text) and their tables."""
    lines = [blocks.prose(line) for line in share_verdicts(found)]
    meaning = (
        "A probe answers from all factors at once. A factor's share is the sum of |integrated gradients| "
        "over its numbers, over the sum of all. It measures how much a factor contributes, not how well: "
        "read it beside the AUC, beside probes of shuffled labels, and beside the AUC lost without it."
    )
    caption = (
        "Bars: mean share over held-out images and seeds; whiskers: 95 % interval over images, or the "
        "standard deviation over seeds if wider. Marks: shuffled labels and an untrained encoder."
    )
    return [
        blocks.prose(meaning),
        *lines,
        blocks.chart(chart, "share of each factor by label", caption),
        blocks.table(share_table(found)),
        blocks.table(drop_table(found)),
    ]


def _sheets(sheets: Mapping[str, Mapping[str, Image.Image]]) -> list[Html]:
    parts = [
        blocks.prose(
            "Each map shows where one factor's encoder saw evidence for the label, the others held. It is "
            "scaled by its own largest value: brightness is where, the percentage how much. A grey image has "
            "no evidence for the label in that factor. Pixels show evidence of either sign. All images shown "
            "carry the label; p is the probability that the probe predicts for it."
        )
    ]
    for label, by_method in sheets.items():
        for method, sheet in by_method.items():
            image = blocks.image(sheet, f"{method} maps of {label}")
            parts.append(blocks.figure(image, f"{label}, {method}: {METHOD_MEANING[method]}"))
    return parts


def _pair(explained: Explained) -> list[Html]:
    if explained.pair is None:
        return []
    names, parts = explained.pair
    images = [explained.images.images[explained.images.files.index(name)] for name in names]
    faces = [
        (blocks.image(Image.fromarray(image.transpose(1, 2, 0)), f"the image {name}", PAIR_WIDTH), name)
        for name, image in zip(names, images, strict=True)
    ]
    return [blocks.prose(PAIRS), blocks.row_of(faces), blocks.table(pair_table(parts, names))]


def _checks(rows: Sequence[Similarity]) -> list[Html]:
    stuck = untrusted(rows)
    trust = (
        f"These maps hardly change (rank correlation {UNCHANGED} or more) when the encoder's weights "
        f"are drawn anew, so they show the image more than the model; do not trust: {'; '.join(stuck)}."
        if stuck
        else f"Every map changes when the encoder's weights are drawn anew (correlation under {UNCHANGED})."
    )
    more = (
        "The same probe is kept. That a map changes does not make it right. Similarity to the map of another "
        "image measures how much of a map is the same for every image."
    )
    whatever = unasked(rows)
    asked = (
        "These change little when the probe has learned shuffled labels: they show the encoder's "
        f"interest, whatever the question: {'; '.join(whatever)}."
        if whatever
        else "Every map also changes when the probe has learned shuffled labels."
    )
    return [
        blocks.prose(blocks.strong(trust)),
        blocks.prose(asked),
        blocks.prose(more),
        blocks.table(sanity_table(rows)),
    ]


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
