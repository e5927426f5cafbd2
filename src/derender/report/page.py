"""One self-contained HTML file: sections of blocks, style and script inline, nothing fetched from anywhere.

The page carries a content security policy that forbids every connection and every script but its own, so
the browser itself holds it to that. Leaves out the blocks (see ``blocks``).
"""

from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from html import escape
from importlib.resources import files
from pathlib import Path

from derender.report.blocks import Html, joined
from derender.whole import whole_file


@dataclass(frozen=True)
class Section:
    """A heading, the blocks under it, and the word that names it in the page's navigation."""

    title: str
    blocks: Sequence[Html]
    short: str = ""


@dataclass(frozen=True)
class Page:
    """A whole report.

    Attributes:
        title: the heading and the browser's title.
        lead: one or two sentences under it.
        sections: in reading order.
        footer: where the page comes from; plain text.
    """

    title: str
    lead: str
    sections: Sequence[Section]
    footer: str = ""

    def html(self) -> str:
        """The complete document."""
        style, script = _resource("page.css"), _resource("page.js")
        digest = b64encode(sha256(script.encode()).digest()).decode()
        policy = (
            f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'; "
            "base-uri 'none'; form-action 'none'"
        )
        links = "".join(
            f'<a href="#section-{number}">{escape(section.short or section.title)}</a>'
            for number, section in enumerate(self.sections, 1)
        )
        return (
            "<!doctype html>\n"
            '<html lang="en"><head><meta charset="utf-8">'
            f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            '<meta name="color-scheme" content="light dark">'
            f"<title>{escape(self.title)}</title><style>{style}</style></head>\n"
            f"<body><header><h1>{escape(self.title)}</h1><p>{escape(self.lead)}</p></header>\n"
            f'<nav aria-label="Sections">{links}</nav>\n<main>\n'
            + "\n".join(_section(number, section) for number, section in enumerate(self.sections, 1))
            + f"\n</main>\n<footer>{escape(self.footer)}</footer>\n<script>{script}</script></body></html>\n"
        )

    def write(self, path: str | Path) -> Path:
        """Write the document to ``path``; whole or not at all."""
        return write_whole(path, self.html().encode("utf-8", errors="replace"))


def write_whole(path: str | Path, content: bytes) -> Path:
    """Write a file whole or not at all; a failure leaves the old one. Makes the folder."""
    path = Path(path)
    with whole_file(path) as temporary:
        temporary.write_bytes(content)
    return path


def _section(number: int, section: Section) -> str:
    content = joined(section.blocks).text
    return f'<section id="section-{number}"><h2>{escape(section.title)}</h2>\n{content}</section>'


def _resource(name: str) -> str:
    return files("derender.report").joinpath(name).read_text(encoding="utf-8")
