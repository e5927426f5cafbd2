"""One self-contained HTML file: sections of blocks, style and script inline, nothing fetched from anywhere.

The page carries a content security policy that forbids every connection and every script but its own, so the
browser itself enforces it. Leaves out the blocks (see ``blocks``); markup is in ``templates/page.html``.
"""

from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from derender.report.blocks import TEMPLATES, Html
from derender.storage.atomic import atomic_file


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
        script = TEMPLATES.get_template("page.js").render()
        digest = b64encode(sha256(script.encode()).digest()).decode()
        return TEMPLATES.get_template("page.html").render(page=self, script=Html(script), digest=digest)

    def write(self, path: str | Path) -> Path:
        """Write the document to ``path``; whole or not at all."""
        return write_whole(path, self.html().encode("utf-8", errors="replace"))


def write_whole(path: str | Path, content: bytes) -> Path:
    """Write a file whole or not at all; a failure leaves the old one. Makes the folder."""
    path = Path(path)
    with atomic_file(path) as temporary:
        temporary.write_bytes(content)
    return path
