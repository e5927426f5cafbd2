"""One self-contained HTML file: a template with its values, style and script inline, nothing fetched.

The page carries a content security policy that forbids every connection and every script but its own, so the
browser itself enforces it. Each page has a template in ``templates/``, which extends ``page.html`` and draws
with the macros of ``blocks.html``. Every text is escaped there; images become data URIs.
"""

from base64 import b64encode
from collections.abc import Mapping
from dataclasses import dataclass, field
from hashlib import sha256
from math import isfinite
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup
from PIL import Image

from derender import __version__
from derender.evaluation.score_table import Interval, ScoreTable
from derender.report.colours import png_bytes
from derender.storage.atomic import write_whole

LONGEST_WORD = 24  # characters of a cell that is kept on one line
TEMPLATES = Environment(
    loader=PackageLoader("derender.report"),
    autoescape=True,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
    undefined=StrictUndefined,
)
IMAGE_TYPES = {b"\x89PNG": "image/png", b"GIF8": "image/gif", b"\xff\xd8\xff": "image/jpeg"}
DIRECTIONS = {"high": "higher is better", "low": "lower is better", None: ""}


@dataclass(frozen=True)
class Page:
    """A whole report."""

    template: str | Template  # the name of one, or one; its block ``main`` holds the sections
    title: str  # the heading and the browser's title
    lead: str  # one or two sentences under it
    values: Mapping[str, Any] = field(default_factory=dict)  # what the template shows, by name
    footer: str = f"derender {__version__}"  # where the page comes from; plain text
    refresh_s: int | None = None  # seconds after which a browser loads the file anew; None: never

    def html(self) -> str:
        """The complete document."""
        script = TEMPLATES.get_template("page.js").render()
        digest = b64encode(sha256(script.encode()).digest()).decode()
        return TEMPLATES.get_template(self.template).render(
            **self.values, page=self, sections=[], script=Markup(script), digest=digest
        )

    def write(self, path: str | Path) -> Path:
        """Write the document to ``path``; whole or not at all."""
        return write_whole(path, self.html().encode("utf-8", errors="replace"))


def data_uri(source: Image.Image | bytes) -> str:
    """An image, or the bytes of a PNG, GIF or JPEG file, as a page holds it."""
    content = source if isinstance(source, bytes) else png_bytes(source)
    for start, kind in IMAGE_TYPES.items():
        if content.startswith(start):
            return f"data:{kind};base64,{b64encode(content).decode()}"
    raise ValueError("a page takes PNG, GIF or JPEG bytes; these are none of them")


def html_cells(scores: ScoreTable, row: Any) -> list[tuple[str, dict[str, str]]]:
    """Text and attributes of each cell of a row: the number to sort by, its share of the largest, a class."""
    cells = []
    for place, (column, cell) in enumerate(zip(scores.columns, row.cells, strict=True)):
        text, attributes = column.text(cell), {}
        if isinstance(cell, str | Interval):
            attributes = {"class": "words"} if len(text) > LONGEST_WORD else {}  # a sentence may break
        elif cell is None or not isfinite(cell):
            attributes = {"class": "none"}
        else:
            attributes["data-value"] = f"{float(cell):.9g}"
            if cell == scores.best(place):
                attributes["class"] = "best"
            if column.best and (largest := scores.largest(place)) > 0:
                attributes["style"] = f"--share:{abs(cell) / largest:.3f}"
        cells.append((text, attributes))
    return cells


TEMPLATES.filters |= {"uri": data_uri, "cells": html_cells}
TEMPLATES.globals |= {"directions": DIRECTIONS}  # pyrefly: ignore[bad-assignment]
