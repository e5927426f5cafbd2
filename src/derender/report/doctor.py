"""The doctor's page: verdict, what is in the way and what to do about it, and the images that show it.

Leaves out measuring (see ``derender.data.doctor``). The page holds images of the set: share it as you would
the set itself.
"""

from collections.abc import Iterable
from dataclasses import asdict
from pathlib import PurePosixPath

import numpy as np
from PIL import Image

from derender import __version__
from derender.data import ImageSet
from derender.data.doctor import CHECKS, CheckFinding, Examination
from derender.evaluation.score_table import Column, Row, ScoreTable
from derender.report import blocks, colours
from derender.report.blocks import Html
from derender.report.page import Page, Section

GAP_PX = 4
UNREADABLE_SHOWN = 200
NAMED = 8
"""Files named under a row of examples, at most."""

_SIGNS = {"objection": "✗ ", "trouble": "! ", "note": "", "open": "? ", "good": "✓ "}
_VERDICTS = {
    "suits": "This set suits the method",
    "will struggle": "The method will struggle with this set",
    "does not suit": "This set does not suit the method",
}


def doctor_page(examination: Examination) -> Page:
    """The whole page for one set of images."""
    sections = [Section("Verdict", _verdict(examination))]
    groups = (
        ("What is in the way", "In the way", ("objection", "trouble")),
        ("Worth knowing", "Notes", ("note", "open")),
        ("What is in order", "In order", ("good",)),
    )
    for title, short, levels in groups:
        chosen = [finding for finding in examination.findings if finding.level in levels]
        if chosen:
            sections.append(Section(title, [_sentence(finding) for finding in chosen], short))
    sections.append(Section("Images that show it", _examples(examination), "Images"))
    sections.append(Section("The numbers", list(_numbers(examination)), "Numbers"))
    return Page(
        "Does this set suit the method?",
        f"{examination.images.describe()}. Examined without training anything.",
        sections,
        f"derender {__version__}. This page holds images of the set: share it as you would the set itself.",
    )


def doctor_blocks(examination: Examination) -> list[Html]:
    """The same in short, for a section of another page: verdict and findings; images and numbers folded."""
    return [
        *_verdict(examination),
        *(_sentence(finding) for finding in examination.findings if finding.level != "good"),
        blocks.folded("Images that show it", *_examples(examination)),
        blocks.folded("The numbers", *_numbers(examination)),
    ]


def measure_table(examination: Examination) -> ScoreTable:
    """Every measured number with its range and its limits."""
    notes = {"value": "", "±": "two standard errors", "will struggle": "limit", "does not suit": "limit"}
    columns = [Column(name, None, 3, note) for name, note in notes.items()]
    rows = []
    for name, check in CHECKS.items():
        if (one := examination.values.get(name)) is not None:
            cells = (one.value, 2 * one.error or None, check.struggles, check.objects)
            rows.append(Row(check.label, cells, note=check.note))
    compared = 0 if examination.shared is None else len(examination.shared.rows)
    caption = f"{len(examination.images):,} images, {compared:,} distinct ones compared"
    return ScoreTable(caption, "measure", columns, rows)


def _verdict(examination: Examination) -> list[Html]:
    verdict, values = examination.verdict, examination.values
    reasons = f": {'; '.join(verdict.because)}." if verdict.because else "."
    tiles = {
        "distinct images": (f"{values['distinct'].value:,.0f}", f"of {len(examination.images):,} readable"),
        "unreadable": (f"{len(examination.images.skipped):,}", "left out"),
    }
    if "agreement" in values:
        least = CHECKS["agreement"].struggles
        tiles["agreement"] = (f"{values['agreement'].value:.2f}", f"should be {least} or more")
    lines = [blocks.prose(blocks.strong(_VERDICTS[verdict.word]), reasons), blocks.key_figures(tiles)]
    if verdict.word == "suits":
        lines.append(blocks.prose("That is what can be seen before training; it promises no result."))
    return lines


def _sentence(finding: CheckFinding) -> Html:
    advice = f" {finding.advice}" if finding.advice else ""
    return blocks.prose(blocks.strong(f"{_SIGNS[finding.level]}{finding.name}: "), finding.text, advice)


def _examples(examination: Examination) -> list[Html]:
    figures: list[Html] = []
    if (mean := examination.mean) is not None:
        both = colours.pictures(np.stack([mean, mean[..., ::-1]]))
        row = [
            (blocks.image(colours.enlarged(image, 128), f"the mean, {name}"), name)
            for image, name in zip(both, ("as it is", "mirrored"), strict=True)
        ]
        caption = "The mean of the distinct images compared. Where they are aligned, it shows a thing."
        figures.append(blocks.figure(blocks.row_of(row), caption))
    for title, rows in examination.examples.items():
        figures.append(_strip(examination.images, title, rows))
    return figures


def _strip(pictures: ImageSet, title: str, rows: tuple[int, ...]) -> Html:
    """Images side by side with transparent gaps."""
    images = colours.pictures(np.stack([pictures.images[row] for row in rows]))
    width, height = images[0].size
    strip = Image.new("RGBA", (len(images) * (width + GAP_PX) - GAP_PX, height), (0, 0, 0, 0))
    for place, image in enumerate(images):
        strip.paste(image, (place * (width + GAP_PX), 0))
    names = ", ".join(PurePosixPath(pictures.files[row]).name for row in rows[:NAMED])
    picture = blocks.image(strip, f"{title}: {len(rows)} images")
    return blocks.figure(picture, f"{title[0].upper()}{title[1:]}: {names}")


def _numbers(examination: Examination) -> Iterable[Html]:
    yield blocks.table(measure_table(examination))
    if examination.originals is not None:
        yield blocks.facts(
            {name.replace("_", " "): one for name, one in asdict(examination.originals).items()}
        )
    if skipped := examination.images.skipped:
        listed = {row.file: row.reason for row in skipped[:UNREADABLE_SHOWN]}
        more = len(skipped) - len(listed)
        rest = [blocks.prose(f"and {more:,} more")] if more > 0 else []
        yield blocks.folded(f"{len(skipped):,} unreadable files", blocks.facts(listed), *rest)
