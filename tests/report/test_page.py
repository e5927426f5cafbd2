"""A page is one file that needs nothing else, shows every text as text, and is written whole."""

import hashlib
import re
from base64 import b64encode
from functools import cache
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from derender.evaluation.score_table import Column, Row, ScoreTable
from derender.report import charts
from derender.report import sweeps as films
from derender.report.page import TEMPLATES, Page, data_uri
from derender.storage.atomic import write_whole

HOSTILE = "<script>alert('x')</script>\"&"
EVERY_BLOCK = TEMPLATES.from_string("""{% extends "page.html" %}{% import "blocks.html" as b %}
{% block main %}{% call b.section(sections, text, text) %}
<p>{{ text }}<strong>{{ text }}</strong></p>
{{ b.key_figures({text: (text, text)}) }}{{ b.facts({text: text}) }}{{ b.definitions({text: text}) }}
{% call b.folded(text) %}{{ text }}{% endcall %}
{% call b.figure(text) %}{% call b.scroll(text) %}{{ b.image(picture, text) }}{% endcall %}{% endcall %}
{{ b.row_of([(picture, text, text)], 64) }}{{ b.films([(film, picture, text)], text) }}
{{ b.image_grid({text: [picture]}, [text], text, {text: text}) }}{{ b.table(table) }}
{% for svg in svgs %}{{ b.chart(svg, text, text) }}{% endfor %}
{% endcall %}{% endblock %}""")
ONE_TABLE = TEMPLATES.from_string("""{% import "blocks.html" as b %}{{ b.table(table) }}""")


def picture(level: int = 90) -> Image.Image:
    return Image.fromarray(np.full((6, 4, 3), level, np.uint8))


@cache
def full_page(text: str = "plain") -> str:
    """One of every block, with ``text`` wherever a text goes."""
    columns, rows = [Column(text, "high", note=text)], [Row(text, [0.5], note=text), Row("c", [text], True)]
    curves = charts.curves({text: ([0, 1], [2, 3])}, text, text)
    bars = charts.bars({text: 1.0, "b": 2.0}, text, [text])
    film = films.animated_png([picture(1), picture(2)])
    table = ScoreTable(text, text, columns, rows)
    values = {"text": text, "picture": picture(), "film": film, "table": table, "svgs": [curves, bars]}
    return Page(EVERY_BLOCK, text, text, values, text).html()


class Elements(HTMLParser):
    """Every element with its attributes."""

    def __init__(self, html: str):
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))


def test_every_text_is_escaped_in_every_block():
    html = full_page(HOSTILE)
    assert HOSTILE not in html
    assert [tag for tag, _ in Elements(html).found].count("script") == 1  # the page's own
    assert html.count("&lt;script&gt;") >= 25


def test_page_refers_to_nothing_outside_itself():
    html = full_page()
    for tag, attributes in Elements(html).found:
        assert tag not in ("link", "iframe", "object", "embed", "base")
        for name in ("src", "href", "srcset", "xlink:href", "action", "data"):
            value = attributes.get(name)
            assert value is None or value.startswith(("data:image/", "#")), (tag, name, value[:80])
    style = html[html.index("<style>") : html.index("</style>")]
    assert "@import" not in style and "url(" not in style
    assert not re.search(r"url\((?!#)", html)


def test_policy_allows_the_page_s_own_script_and_no_other():
    html = full_page()
    script = re.search(r"<script>(.*?)</script>", html, re.DOTALL)
    assert script is not None
    digest = b64encode(hashlib.sha256(script[1].encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in html
    assert "default-src 'none'" in html


def test_every_image_has_an_alternative_text_and_every_link_a_target():
    elements = Elements(full_page()).found
    assert all(attributes.get("alt") for tag, attributes in elements if tag == "img")
    ids = {attributes["id"] for _, attributes in elements if "id" in attributes}
    links = [attributes["href"] or "" for tag, attributes in elements if tag == "a"]
    assert links and all(link[1:] in ids for link in links)


def test_ids_of_several_charts_do_not_meet():
    svgs = [charts.curves({"a": ([0, 1], [0, y])}, "x", "y") for y in (1.0, 2.0)]
    ids = [re.findall(r' id="([^"]+)"', svg) for svg in svgs]
    assert ids[0] and not set(ids[0]) & set(ids[1])
    for svg, own in zip(svgs, ids, strict=True):
        assert set(re.findall(r'(?:url\(#|href="#)([^)"]+)', svg)) == set(own)


def test_charts_take_the_colour_of_the_page_and_are_the_same_every_time():
    first, again = (charts.bars({"a": 1.0, "b": 0.5}, "score") for _ in range(2))
    assert first == again
    assert "currentColor" in first and "#010203" not in first
    assert ">score</text>" in first  # text stays text


def test_table_marks_the_best_and_gives_numbers_to_sort_by():
    columns = [Column("up", "high"), Column("down", "low", 1), Column("size")]
    rows = [Row("ours", [0.4, 3.0, 1200]), Row("pixels", [0.5, 2.0, 7], True)]
    rows += [Row("none", [None, float("nan"), "-"], True)]
    html = ONE_TABLE.render(table=ScoreTable("scores", "features", columns, rows))
    best = re.findall(r'<td data-value="([^"]+)" class="best"', html)
    assert best == ["0.5", "2"]
    assert html.count('class="none"') == 2
    assert ">1,200<" in html and '<tr class="control">' in html


def test_bytes_that_are_no_image_are_refused():
    with pytest.raises(ValueError, match="PNG, GIF or JPEG"):
        data_uri(b"<svg onload=alert(1)>")


def test_write_is_whole_and_leaves_the_old_file_on_failure(tmp_path: Path, monkeypatch):
    page = Page("comparison.html", "title", "lead", {"tables": [], "failed": ["text"], "settings": {}})
    file = page.write(tmp_path / "new" / "folder" / "page.html")
    assert file.read_text() == page.html()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OSError, match="No space left"):
        write_whole(file, b"half")
    monkeypatch.undo()
    assert file.read_text() == page.html()
    assert [entry.name for entry in file.parent.iterdir()] == ["page.html"]
