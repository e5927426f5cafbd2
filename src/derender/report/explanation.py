"""The page of an explanation: shares beside controls, maps over pictures, and whether to trust them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from PIL import Image

import derender
from derender.interpretation import ClusterShares, Explanation, PairParts
from derender.interpretation.sanity import UNCHANGED, Similarity
from derender.report import blocks
from derender.report.blocks import Html
from derender.report.page import Page, Section
from derender.report.tables_explanation import (
    cluster_share_table,
    drop_table,
    pair_table,
    sanity_table,
    share_table,
    share_verdicts,
    unasked,
    untrusted,
)

METHOD_MEANING = {
    "grad-cam": "Grad-CAM at the encoder's last spatial convolution (4 x 4 places): the paper's. It averages "
    "the gradient over places and can light up where the answer does not look.",
    "hires-cam": "Gradient times feature place by place, at the same convolution: what lights up was used.",
    "pixels": "Integrated gradients of the pixels through the whole encoder, from a grey picture, absolute "
    "and slightly smoothed.",
    "fresh weights": "Grad-CAM of the same networks with weights drawn anew and the same probe: what a map "
    "looks like that knows nothing. The shares are those of the fresh networks.",
    "feature": "Grad-CAM of the factor's own feature (half its squared length), whatever is asked of it.",
}


NAMED, PAIR_WIDTH = 6, 160


@dataclass(frozen=True)
class Pair:
    """Two pictures, and what makes them alike.

    Attributes:
        parts: of their distance and cosine.
        names: of their files.
        images: (2, 3, H, W) uint8.
    """

    parts: PairParts
    names: tuple[str, str]
    images: np.ndarray


@dataclass(frozen=True)
class Shown:
    """What a page is made of.

    Attributes:
        found: the shares.
        chart: SVG text of the shares.
        source: of the pictures.
        model: where the model came from.
        sheets: label to method to sheet of maps.
        checks: how maps answered to random weights.
        clusters: parts of each cluster, if any were asked for.
        pair: if asked for.
    """

    found: Explanation
    chart: str
    source: str
    model: str
    sheets: Mapping[str, Mapping[str, Image.Image]] = field(default_factory=dict)
    checks: Sequence[Similarity] = ()
    clusters: ClusterShares | None = None
    pair: Pair | None = None


def explanation_page(shown: Shown) -> Page:
    """One self-contained page."""
    found = shown.found
    sections = [Section("Which factor answers", share_blocks(found, shown.chart), "Shares")]
    if shown.sheets:
        sections.append(Section("Where it was seen", _sheets(shown), "Maps"))
    if shown.checks:
        sections.append(Section("Whether the maps can be trusted", _checks(shown.checks), "Sanity"))
    groups: list[Html] = []
    if shown.clusters is not None:
        groups += [
            blocks.prose(
                "Ward clusters of the features above. The squared distance between a cluster's mean and that "
                "of all other pictures is the sum of its parts by factor, exactly. Parts depend on how large "
                "a factor's features are; the ratio of variances does not."
            ),
            blocks.table(cluster_share_table(shown.clusters)),
        ]
    if shown.pair is not None:
        groups += _pair(shown.pair)
    if groups:
        sections.append(Section("What groups pictures", groups, "Groups"))
    count = len(found.names)
    more = f" and {count - NAMED} more" if count > NAMED else ""
    asked = (
        f"{count} yes/no labels"
        if found.kind == "labels" and count > 1
        else ", ".join(found.names[:NAMED]) + more
    )
    return Page(
        "Which factor made the answer",
        f"{shown.model} on {shown.source}: {asked}.",
        sections,
        f"derender {derender.__version__}",
    )


def share_blocks(found: Explanation, chart: str) -> list[Html]:
    """Verdicts, the chart of the shares (SVG text) and their tables."""
    lines = [blocks.prose(line) for line in share_verdicts(found)]
    meaning = (
        "A probe answers from all factors at once. A factor's share is the sum of |integrated gradients| "
        "over its numbers, over the sum of all. It tells how much a factor speaks, not how well: read it "
        "beside the AUC, beside probes of labels dealt at random, and what is lost without it."
    )
    caption = (
        "Bars: mean share over held-out pictures and seeds; whiskers: 95 % interval over pictures, or the "
        "spread over seeds if wider. Marks: the same for labels dealt at random and for an untrained encoder."
    )
    return [
        blocks.prose(meaning),
        *lines,
        blocks.chart(chart, "share of each factor by label", caption),
        blocks.table(share_table(found)),
        blocks.table(drop_table(found)),
    ]


def _sheets(shown: Shown) -> list[Html]:
    parts = [
        blocks.prose(
            "Each map shows where one factor's encoder saw evidence for the label, the others held. It is "
            "scaled by its own largest value: brightness says where, the percentage how much. A grey "
            "picture has no evidence for the label in that factor. Pixels show evidence of either sign. All "
            "pictures shown carry the label; p is the probability that the probe gives it."
        )
    ]
    for label, sheets in shown.sheets.items():
        for method, sheet in sheets.items():
            image = blocks.image(sheet, f"{method} maps of {label}")
            parts.append(blocks.figure(image, f"{label}, {method}: {METHOD_MEANING[method]}"))
    return parts


def _pair(pair: Pair) -> list[Html]:
    faces = [
        (blocks.image(Image.fromarray(image.transpose(1, 2, 0)), f"the picture {name}", PAIR_WIDTH), name)
        for name, image in zip(pair.names, pair.images, strict=True)
    ]
    meaning = (
        "The squared distance and the cosine of two pictures' features are sums of parts by factor, exactly; "
        "parts depend on how large a factor's features are. What does not: the cosine of each factor alone, "
        "and how many of the data's random pairs lie farther apart in it (alike; 1: all of them)."
    )
    return [blocks.prose(meaning), blocks.row_of(faces), blocks.table(pair_table(pair.parts, pair.names))]


def _checks(rows: Sequence[Similarity]) -> list[Html]:
    stuck = untrusted(rows)
    said = (
        f"These maps stay much as they are (rank correlation {UNCHANGED} or more) when the encoder's weights "
        f"are drawn anew, so they show the picture more than the model; do not trust: {'; '.join(stuck)}."
        if stuck
        else f"Every map changes when the encoder's weights are drawn anew (correlation under {UNCHANGED})."
    )
    more = (
        "The same probe is kept. That a map changes does not make it right. Similarity to the map of another "
        "picture tells how much of a map is the same for every picture."
    )
    whatever = unasked(rows)
    asked = (
        "These change little when the probe has learned labels dealt at random: they show what the encoder "
        f"looks at whatever is asked: {'; '.join(whatever)}."
        if whatever
        else "Every map also changes when the probe has learned labels dealt at random."
    )
    return [
        blocks.prose(blocks.strong(said)),
        blocks.prose(asked),
        blocks.prose(more),
        blocks.table(sanity_table(rows)),
    ]
