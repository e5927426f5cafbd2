"""The doctor's page: verdict, what is in the way and what to do about it, and the images that show it.

Leaves out measuring (see ``derender.data.doctor``). The page holds images of the set: share it as you would
the set itself.
"""

from typing import Any

import numpy as np

from derender import __version__
from derender.data.doctor import CHECKS, Examination
from derender.evaluation.score_table import Column, Row, ScoreTable
from derender.report.colours import enlarged, pictures
from derender.report.page import Page
from derender.report.panel import strip
from derender.storage.places import counted


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
    images, mean = examination.images, examination.mean
    mirrored = [] if mean is None else pictures(np.stack([mean, mean[..., ::-1]]))
    return {
        "examination": examination,
        "least": CHECKS["agreement"].struggles,
        "mean": [enlarged(image, 128) for image in mirrored],
        "strips": {
            title: strip(pictures(images.images[list(rows)]), gap=4)
            for title, rows in examination.examples.items()
        },
        "measures": measure_table(examination),
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
    caption = f"{counted(len(examination.images), 'images')}, {compared:,} distinct ones compared"
    return ScoreTable(caption, "measure", [Column(name, None, 3, note) for name, note in notes.items()], rows)
