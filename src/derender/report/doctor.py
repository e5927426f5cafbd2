"""The doctor's page: verdict, what is in the way and what to do about it, and the pictures that show it.

Leaves out measuring (see ``derender.data.doctor``). The page holds pictures of the set: share it as you would
the set itself.
"""

from collections.abc import Iterable
from pathlib import PurePosixPath

import numpy as np
from PIL import Image

from derender import __version__
from derender.data import PictureSet
from derender.data.doctor import Examination, Finding
from derender.data.doctor.counting import count_of
from derender.data.doctor.estimate import Estimate
from derender.data.doctor.limits import LIMITS
from derender.evaluation.score_table import Cell, Column, Row, ScoreTable
from derender.report import blocks, colours
from derender.report.blocks import Html
from derender.report.page import Page, Section

GAP_PX = 4
UNREADABLE_SHOWN = 200
NAMED = 8
"""Files named under a row of examples, at most."""


def doctor_page(pictures: PictureSet, found: Examination) -> Page:
    """The whole page for one set of pictures."""
    sections = [Section("Verdict", _verdict(pictures, found))]
    groups = (
        ("What is in the way", "In the way", ("objection", "trouble")),
        ("Worth knowing", "Notes", ("note", "open")),
        ("What is in order", "In order", ("good",)),
    )
    for title, short, levels in groups:
        chosen = [finding for finding in found.findings if finding.level in levels]
        if chosen:
            sections.append(Section(title, [_told(finding) for finding in chosen], short))
    sections.append(Section("Pictures that show it", _shown(pictures, found), "Pictures"))
    sections.append(Section("The numbers", [*_numbers(found), *_unreadable(pictures)], "Numbers"))
    return Page(
        "Does this set suit the method?",
        f"{pictures.describe()}. Examined without training anything.",
        sections,
        f"derender {__version__}. This page holds pictures of the set: share it as you would the set itself.",
    )


def doctor_blocks(pictures: PictureSet, found: Examination) -> list[Html]:
    """The same in short, for a section of another page: verdict and findings; pictures and numbers folded."""
    return [
        *_verdict(pictures, found),
        *(_told(finding) for finding in found.findings if finding.level != "good"),
        blocks.folded("Pictures that show it", *_shown(pictures, found)),
        blocks.folded("The numbers", *_numbers(found), *_unreadable(pictures)),
    ]


def measure_table(found: Examination) -> ScoreTable:
    """Every measured number with its range and its limits."""
    columns = (
        Column("value", None, 3),
        Column("±", None, 3, "two standard errors"),
        Column("will struggle", None, 3, "limit"),
        Column("does not suit", None, 3, "limit"),
    )
    measures, shared = found.measures, found.measures.shared
    rows = [
        Row(
            "distinct pictures",
            (measures.distinct, None, LIMITS.distinct_struggles, LIMITS.distinct_objects),
            note="copies and near copies counted once; more is better",
        ),
        Row(
            "copies",
            (1 - measures.distinct / measures.pictures, None, LIMITS.copies_struggles, None),
            note="share of all pictures, 0 to 1; less is better",
        ),
        Row(
            "clipped",
            (measures.clipped, None, LIMITS.clipped_struggles, None),
            note="mean share of pixels that are black or white; less is better",
        ),
    ]
    if shared is None:
        return ScoreTable(f"{count_of(measures.pictures, 'picture')}", "measure", columns, rows)

    def row(name: str, value: Estimate, limits: tuple[Cell, Cell], note: str) -> Row:
        return Row(name, (value.value, 2 * value.error, *limits), note=note)

    rows += [
        row(
            "agreement",
            shared.agreement,
            (LIMITS.agreement_struggles, LIMITS.agreement_objects),
            "mean cosine between the edges of two pictures; 0 for landscapes, textures, noise",
        ),
        row(
            "symmetry",
            shared.symmetry,
            (LIMITS.symmetry_struggles, LIMITS.symmetry_objects),
            "agreement with other pictures' mirror images over agreement; best 1",
        ),
        row(
            "frame filled",
            shared.fill,
            (LIMITS.fill_struggles, None),
            "share of the frame that the common structure covers",
        ),
        row(
            "variety of view",
            shared.view,
            (LIMITS.view_flat, None),
            "distance to the own mirror image over that to others'; 0 all from the front",
        ),
        row(
            "variety of light",
            shared.light,
            (LIMITS.light_struggles, LIMITS.light_flat),
            "spread of the left's brightness against the right's; 0 all lit alike",
        ),
        row("odd ones", shared.odd, (LIMITS.odd_struggles, None), "share of pictures unlike the others"),
    ]
    if shared.halves is not None:
        rows.append(
            row(
                "kinship",
                shared.halves.kinship,
                (None, LIMITS.kinship_objects),
                "agreement across the two most different groups over that within; 1 for one kind",
            )
        )
    compared = f"agreement and what follows on {count_of(len(shared.rows), 'distinct picture')}"
    return ScoreTable(f"{count_of(measures.pictures, 'picture')}; {compared}", "measure", columns, rows)


def _verdict(pictures: PictureSet, found: Examination) -> list[Html]:
    verdict, measures = found.verdict, found.measures
    reasons = f": {'; '.join(verdict.because)}." if verdict.because else "."
    word = {
        "suits": "This set suits the method",
        "will struggle": "The method will struggle with this set",
        "does not suit": "This set does not suit the method",
    }[verdict.word]
    tiles = {
        "distinct pictures": (f"{measures.distinct:,}", f"of {measures.pictures:,} readable"),
        "unreadable": (f"{len(pictures.skipped):,}", "left out"),
    }
    shared = measures.shared
    if shared is not None:
        tiles["agreement"] = (
            f"{shared.agreement.value:.2f}",
            f"asked for: {LIMITS.agreement_struggles} or more",
        )
    lines = [blocks.prose(blocks.strong(word), reasons), blocks.key_figures(tiles)]
    if verdict.word == "suits":
        lines.append(blocks.prose("That is what can be seen before training; it promises no result."))
    return lines


def _told(finding: Finding) -> Html:
    sign = {"objection": "✗ ", "trouble": "! ", "note": "", "open": "? ", "good": "✓ "}[finding.level]
    advice = f" {finding.advice}" if finding.advice else ""
    return blocks.prose(blocks.strong(f"{sign}{finding.name}: "), finding.text, advice)


def _shown(pictures: PictureSet, found: Examination) -> list[Html]:
    shown: list[Html] = []
    if found.mean is not None:
        mean = colours.enlarged(colours.pictures(found.mean[None])[0], 128)
        mirror = colours.enlarged(colours.pictures(found.mean[None, :, :, ::-1])[0], 128)
        row = [
            (blocks.image(mean, "mean of the pictures"), "mean"),
            (blocks.image(mirror, "the mean, mirrored"), "mirrored"),
        ]
        shown.append(
            blocks.figure(
                blocks.row_of(row),
                "The mean of the distinct pictures compared. Where they are aligned, it shows a thing.",
            )
        )
    for title, rows in found.examples.items():
        images = colours.pictures(np.stack([pictures.images[row] for row in rows]))
        names = ", ".join(PurePosixPath(pictures.files[row]).name for row in rows[:NAMED])
        strip = blocks.image(_strip(images), f"{title}: {len(rows)} pictures")
        shown.append(blocks.figure(strip, f"{title[0].upper()}{title[1:]}: {names}"))
    return shown


def _strip(images: colours.Images) -> Image.Image:
    """Pictures side by side with transparent gaps."""
    width, height = images[0].size
    strip = Image.new("RGBA", (len(images) * (width + GAP_PX) - GAP_PX, height), (0, 0, 0, 0))
    for place, image in enumerate(images):
        strip.paste(image, (place * (width + GAP_PX), 0))
    return strip


def _numbers(found: Examination) -> Iterable[Html]:
    yield blocks.table(measure_table(found))
    if found.originals is not None:
        sizes = found.originals
        yield blocks.facts(
            {
                "short sides": f"{sizes.median_short} pixels in the median, {sizes.smallest_short} at least",
                "longest side": f"{sizes.largest_long} pixels",
                "far from square": f"{100 * sizes.oblong:.0f} % of {count_of(sizes.sampled, 'file')}",
            }
        )


def _unreadable(pictures: PictureSet) -> Iterable[Html]:
    if pictures.skipped:
        listed = {row.file: row.reason for row in pictures.skipped[:UNREADABLE_SHOWN]}
        more = len(pictures.skipped) - len(listed)
        rest = [blocks.prose(f"and {more:,} more")] if more > 0 else []
        yield blocks.folded(
            f"{count_of(len(pictures.skipped), 'unreadable file')}", blocks.facts(listed), *rest
        )
