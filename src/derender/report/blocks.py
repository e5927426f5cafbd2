"""What a report page is made of: prose, key figures, figures, grids of images, tables with controls.

Every function takes plain values and returns ``Html``, whose text is already escaped; a plain ``str``
never becomes markup. Images become data URIs. Leaves out the page around the blocks (see ``page``).
"""

from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from io import BytesIO
from math import isfinite

from PIL import Image

from derender.report.colours import Images, same_length
from derender.report.score_table import Cell, Column, ScoreTable

LONGEST_WORD = 24  # characters of a cell that is kept on one line


@dataclass(frozen=True)
class Html:
    """Markup that is safe to put into a page as it is."""

    text: str


def joined(blocks: Iterable[Html]) -> Html:
    return Html("\n".join(block.text for block in blocks))


def strong(text: str) -> Html:
    return Html(f"<strong>{escape(text)}</strong>")


def code(text: str) -> Html:
    return Html(f"<code>{escape(text)}</code>")


def prose(*parts: str | Html) -> Html:
    """One paragraph of plain text (escaped) and ``strong``/``code`` pieces."""
    return Html(
        "<p>" + "".join(part.text if isinstance(part, Html) else escape(part) for part in parts) + "</p>"
    )


def listing(command: str) -> Html:
    """Commands or other text in a fixed-width box."""
    return Html(f"<pre><code>{escape(command)}</code></pre>")


def key_figures(figures: Mapping[str, tuple[str, str]]) -> Html:
    """Large numbers: name to (value, what to compare it with)."""
    tiles = "".join(
        f"<div><dt>{escape(name)}</dt><dd><b>{escape(value)}</b><span>{escape(note)}</span></dd></div>"
        for name, (value, note) in figures.items()
    )
    return Html(f'<dl class="tiles">{tiles}</dl>')


def facts(values: Mapping[str, object]) -> Html:
    """Settings and versions: name and value, one line each."""
    lines = "".join(
        f"<dt>{escape(str(name))}</dt><dd>{escape(str(value))}</dd>" for name, value in values.items()
    )
    return Html(f'<dl class="facts">{lines}</dl>')


def folded(title: str, *blocks: Html) -> Html:
    """Blocks that open on request."""
    return Html(f"<details><summary>{escape(title)}</summary>{joined(blocks).text}</details>")


def png_bytes(image: Image.Image) -> bytes:
    stream = BytesIO()
    image.save(stream, format="PNG", optimize=True)
    return stream.getvalue()


def image(source: Image.Image | bytes, alt: str, width: int | None = None) -> Html:
    """One image (PIL, or PNG/GIF/JPEG bytes) as a data URI; ``width`` in CSS pixels."""
    content = source if isinstance(source, bytes) else png_bytes(source)
    size = f' width="{width}"' if width else ""
    return Html(f'<img alt="{escape(alt)}"{size} src="{_data_uri(content)}">')


def wide(content: Html, alt: str) -> Html:
    """An image with small parts: on a narrow screen it keeps a readable width and scrolls by itself."""
    return Html(
        f'<div class="scroll wide" tabindex="0" role="group" aria-label="{escape(alt)}">{content.text}</div>'
    )


def film(moving: bytes, still: Image.Image, alt: str, width: int | None = None) -> Html:
    """An animated image; readers who ask for reduced motion get ``still`` in its place."""
    uri = _data_uri(png_bytes(still))
    source = f'<source media="(prefers-reduced-motion: reduce)" srcset="{uri}">'
    return Html(f"<picture>{source}{image(moving, alt, width).text}</picture>")


def figure(content: Html, caption: str) -> Html:
    """An image, chart or row of films with its caption."""
    return Html(f"<figure>{content.text}<figcaption>{escape(caption)}</figcaption></figure>")


def chart(svg: str, alt: str, caption: str) -> Html:
    """SVG text made by ``charts`` as a figure."""
    return figure(Html(f'<div class="chart" role="img" aria-label="{escape(alt)}">{svg}</div>'), caption)


def row_of(items: Sequence[tuple[Html, str]]) -> Html:
    """Images or films next to each other, each with a short label; they wrap on small screens."""
    cells = "".join(f"<div>{content.text}<span>{escape(label)}</span></div>" for content, label in items)
    return Html(f'<div class="row">{cells}</div>')


def image_grid(
    columns: Mapping[str, Images],
    row_names: Sequence[str],
    caption: str,
    meaning: Mapping[str, str] | None = None,
    show_names: bool = True,
) -> Html:
    """Images in rows (pictures) and named columns; each image's alt text is its column and row name."""
    rows = same_length(list(columns.values()))
    if len(row_names) != rows:
        raise ValueError(f"expected {rows} row names, one per picture; got {len(row_names)}")
    meaning = meaning or {}
    head = "".join(
        f'<th scope="col"{_tooltip(meaning.get(name, ""))}>{escape(name)}</th>' for name in columns
    )
    body = ""
    for index, row_name in enumerate(row_names):
        label = f'<th scope="row">{escape(row_name)}</th>' if show_names else ""
        cells = "".join(
            f"<td>{image(images[index], f'{name}: {row_name}').text}</td>" for name, images in columns.items()
        )
        body += f"<tr>{label}{cells}</tr>"
    corner = '<th aria-hidden="true"></th>' if show_names else ""
    table = f'<table class="images"><thead><tr>{corner}{head}</tr></thead><tbody>{body}</tbody></table>'
    return figure(
        Html(f'<div class="scroll" tabindex="0" role="group" aria-label="{escape(caption)}">{table}</div>'),
        caption,
    )


def definitions(meaning: Mapping[str, str]) -> Html:
    """Words and what they mean."""
    return Html(
        '<dl class="words">'
        + "".join(
            f"<div><dt>{escape(word)}</dt><dd>{escape(text)}</dd></div>" for word, text in meaning.items()
        )
        + "</dl>"
    )


def table(scores: ScoreTable) -> Html:
    """Numbers with controls: the best of each column is bold, a click on a head sorts."""
    columns, rows = scores.columns, scores.rows
    head = f'<th scope="col">{escape(scores.first)}</th>' + "".join(_head(column) for column in columns)
    body = ""
    for row in rows:
        cells = "".join(
            _cell(cell, column, scores.best(index), scores.largest(index))
            for index, (cell, column) in enumerate(zip(row.cells, columns, strict=True))
        )
        note = f"<small>{escape(row.note)}</small>" if row.note else ""
        kind = ' class="control"' if row.control else ""
        body += f'<tr{kind}><th scope="row">{escape(row.name)}{note}</th>{cells}</tr>'
    caption = escape(scores.caption)
    text = (
        f'<table class="numbers sortable"><caption>{caption}</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    )
    return Html(f'<div class="scroll" tabindex="0" role="group" aria-label="{caption}">{text}</div>')


def _head(column: Column) -> str:
    arrow = {"high": " ↑", "low": " ↓", None: ""}[column.best]
    spoken = {"high": "higher is better", "low": "lower is better", None: ""}[column.best]
    note = "; ".join(part for part in (column.note, spoken) if part)
    return f'<th scope="col"{_tooltip(note)}>{escape(column.name)}{arrow}</th>'


def _cell(cell: Cell, column: Column, best: float | None, largest: float) -> str:
    if isinstance(cell, str):
        words = ' class="words"' if len(cell) > LONGEST_WORD else ""  # a sentence may break
        return f"<td{words}>{escape(cell)}</td>"
    if cell is None or not isfinite(cell):
        return '<td class="none">-</td>'
    kind = ' class="best"' if best is not None and cell == best else ""
    share = f' style="--share:{abs(cell) / largest:.3f}"' if column.best and largest > 0 else ""
    return f'<td data-value="{float(cell):.9g}"{kind}{share}>{column.text(cell)}</td>'


def _tooltip(text: str) -> str:
    return f' title="{escape(text)}"' if text else ""


def _data_uri(content: bytes) -> str:
    kinds = {b"\x89PNG": "png", b"GIF8": "gif", b"\xff\xd8\xff": "jpeg"}
    kind = next((name for start, name in kinds.items() if content.startswith(start)), None)
    if kind is None:
        raise ValueError("a page takes PNG, GIF or JPEG bytes; these are none of them")
    return f"data:image/{kind};base64,{b64encode(content).decode()}"
