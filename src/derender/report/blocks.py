"""Blocks of a report page: prose, key figures, figures, grids of images, tables with controls.

Every function takes plain values and returns ``Html``: text is escaped by the templates
(``templates/blocks.html``), and a plain ``str`` never becomes markup. Images become data URIs. Leaves out the
page around the blocks (see ``page``).
"""

from base64 import b64encode
from collections.abc import Mapping, Sequence
from io import BytesIO
from math import isfinite
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup as Html
from PIL import Image

from derender.evaluation.score_table import Cell, Column, Interval, ScoreTable
from derender.report.colours import Images, same_length

LONGEST_WORD = 24  # characters of a cell that is kept on one line
TEMPLATES = Environment(
    loader=PackageLoader("derender.report"),
    autoescape=True,
    trim_blocks=True,
    keep_trailing_newline=True,
    undefined=StrictUndefined,
)
_macros: Any = TEMPLATES.get_template("blocks.html").module


def strong(text: str) -> Html:
    return Html(_macros.strong(text))


def code(text: str) -> Html:
    return Html(_macros.code(text))


def prose(*parts: str | Html) -> Html:
    """One paragraph of plain text (escaped) and ``strong``/``code`` pieces."""
    return Html(_macros.prose(parts))


def listing(command: str) -> Html:
    """Commands or other text in a fixed-width box."""
    return Html(_macros.listing(command))


def key_figures(figures: Mapping[str, tuple[str, str]]) -> Html:
    """Large numbers: name to (value, what to compare it with)."""
    return Html(_macros.key_figures(figures))


def facts(values: Mapping[str, object]) -> Html:
    """Settings and versions: name and value, one line each."""
    return Html(_macros.facts(values))


def definitions(meaning: Mapping[str, str]) -> Html:
    """Words and what they mean."""
    return Html(_macros.definitions(meaning))


def folded(title: str, *blocks: Html) -> Html:
    """Blocks that open on request."""
    return Html(_macros.folded(title, blocks))


def png_bytes(image: Image.Image) -> bytes:
    """A compact PNG file."""
    stream = BytesIO()
    image.save(stream, format="PNG", optimize=True)
    return stream.getvalue()


def image(source: Image.Image | bytes, alt: str, width: int | None = None) -> Html:
    """One image (PIL, or PNG/GIF/JPEG bytes) as a data URI; ``width`` in CSS pixels."""
    return Html(_macros.image(_data_uri(source), alt, width))


def wide(content: Html, alt: str) -> Html:
    """An image with small parts: on a narrow screen it keeps a readable width and scrolls by itself."""
    return Html(_macros.scroll(alt, content, "scroll wide"))


def film(moving: bytes, still: Image.Image, alt: str, width: int | None = None) -> Html:
    """An animated image; readers who ask for reduced motion get ``still`` in its place."""
    return Html(_macros.film(_data_uri(moving), _data_uri(still), alt, width))


def figure(content: Html, caption: str) -> Html:
    """An image, chart or row of films with its caption."""
    return Html(_macros.figure(content, caption))


def chart(svg: str, alt: str, caption: str) -> Html:
    """SVG text made by ``charts`` as a figure."""
    return figure(_macros.chart(Html(svg), alt), caption)


def row_of(items: Sequence[tuple[Html, str]]) -> Html:
    """Images or films next to each other, each with a short label; they wrap on small screens."""
    return Html(_macros.row_of(items))


def image_grid(
    columns: Mapping[str, Images],
    row_names: Sequence[str],
    caption: str,
    meaning: Mapping[str, str] | None = None,
    show_names: bool = True,
) -> Html:
    """Images in rows (one per input) and named columns; each image's alt text is its column and row name."""
    count = same_length(list(columns.values()))
    if len(row_names) != count:
        raise ValueError(f"expected {count} row names, one per image; got {len(row_names)}")
    rows = [
        (row, [image(images[index], f"{name}: {row}") for name, images in columns.items()])
        for index, row in enumerate(row_names)
    ]
    return figure(
        _macros.scroll(caption, _macros.image_grid(list(columns), rows, meaning or {}, show_names)), caption
    )


def table(scores: ScoreTable) -> Html:
    """Numbers with controls: the best of each column is bold, a click on a head sorts."""
    rows = [
        (
            row,
            [
                _cell(cell, column, scores.best(index), scores.largest(index))
                for index, (cell, column) in enumerate(zip(row.cells, scores.columns, strict=True))
            ],
        )
        for row in scores.rows
    ]
    heads = [_head(column) for column in scores.columns]
    return Html(_macros.scroll(scores.caption, _macros.table(scores, heads, rows)))


def _head(column: Column) -> tuple[str, str]:
    """Text and tooltip of a column's head."""
    direction = {"high": "higher is better", "low": "lower is better", None: ""}[column.best]
    return column.head, "; ".join(part for part in (column.note, direction) if part)


def _cell(cell: Cell, column: Column, best: float | None, largest: float) -> tuple[str, dict[str, str]]:
    """Text and attributes of a cell."""
    if isinstance(cell, Interval):
        cell = column.text(cell)
    if isinstance(cell, str):
        return cell, {"class": "words"} if len(cell) > LONGEST_WORD else {}  # a sentence may break
    if cell is None or not isfinite(cell):
        return "-", {"class": "none"}
    attributes = {"data-value": f"{float(cell):.9g}"}
    if best is not None and cell == best:
        attributes["class"] = "best"
    if column.best and largest > 0:
        attributes["style"] = f"--share:{abs(cell) / largest:.3f}"
    return column.text(cell), attributes


def _data_uri(source: Image.Image | bytes) -> str:
    content = source if isinstance(source, bytes) else png_bytes(source)
    kinds = {b"\x89PNG": "png", b"GIF8": "gif", b"\xff\xd8\xff": "jpeg"}
    kind = next((name for start, name in kinds.items() if content.startswith(start)), None)
    if kind is None:
        raise ValueError("a page takes PNG, GIF or JPEG bytes; these are none of them")
    return f"data:image/{kind};base64,{b64encode(content).decode()}"
