"""The doctor's page: verdict, what is in the way and what to do about it, and the images that show it.

Leaves out measuring (see ``derender.data.doctor``). The page holds images of the set: share it as you would
the set itself.
"""

from dataclasses import asdict
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from derender import __version__
from derender.data.doctor import CHECKS, Examination
from derender.evaluation.score_table import Column, Row, ScoreTable
from derender.report.colours import enlarged, pictures
from derender.report.page import Page
from derender.report.panel import strip

GAP_PX = 4
UNREADABLE_SHOWN = 200
NAMED = 8
"""Files named under a row of examples, at most."""


def doctor_page(examination: Examination) -> Page:
    """The whole page for one set of images."""
    return Page(
        "doctor.html",
        "Does this set suit the method?",
        f"{examination.images.describe()}. Examined without training anything.",
        {"found": doctor_values(examination)},
        f"derender {__version__}. This page holds images of the set: share it as you would the set itself.",
    )


def doctor_values(examination: Examination) -> dict[str, Any]:
    """What ``templates/findings.html`` shows of an examination."""
    verdict, values, images = examination.verdict, examination.values, examination.images
    skipped = {row.file: row.reason for row in images.skipped}
    tiles = {
        "distinct images": (f"{values['distinct'].value:,.0f}", f"of {len(images):,} readable"),
        "unreadable": (f"{len(skipped):,}", "left out"),
    }
    if "agreement" in values:
        least = CHECKS["agreement"].struggles
        tiles["agreement"] = (f"{values['agreement'].value:.2f}", f"should be {least} or more")
    mean, examples = [], []
    if examination.mean is not None:
        both = pictures(np.stack([examination.mean, examination.mean[..., ::-1]]))
        names = ("as it is", "mirrored")
        mean = [
            (enlarged(image, 128), f"the mean, {name}", name) for image, name in zip(both, names, strict=True)
        ]
    for title, rows in examination.examples.items():
        shown = strip(pictures(np.stack([images.images[row] for row in rows])), GAP_PX)
        names = ", ".join(PurePosixPath(images.files[row]).name for row in rows[:NAMED])
        caption = f"{title[0].upper()}{title[1:]}: {names}"
        examples.append((shown, f"{title}: {len(rows)} images", caption))
    originals = {} if examination.originals is None else asdict(examination.originals)
    return {
        "verdict": verdict.word,
        "reasons": "; ".join(verdict.because),
        "tiles": tiles,
        "findings": examination.findings,
        "mean": mean,
        "examples": examples,
        "measures": measure_table(examination),
        "originals": {name.replace("_", " "): one for name, one in originals.items()},
        "skipped": skipped,
        "listed": dict(list(skipped.items())[:UNREADABLE_SHOWN]),
    }


def measure_table(examination: Examination) -> ScoreTable:
    """Every measured number with its range and its limits."""
    notes = {"value": "", "±": "two standard errors", "will struggle": "limit", "does not suit": "limit"}
    rows = []
    for name, check in CHECKS.items():
        if (one := examination.values.get(name)) is not None:
            cells = (one.value, 2 * one.error or None, check.struggles, check.objects)
            rows.append(Row(check.label, cells, note=check.note))
    compared = 0 if examination.shared is None else len(examination.shared.rows)
    caption = f"{len(examination.images):,} images, {compared:,} distinct ones compared"
    return ScoreTable(caption, "measure", [Column(name, None, 3, note) for name, note in notes.items()], rows)
