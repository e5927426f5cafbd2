"""The page's own files: they need nothing from elsewhere, write no text as HTML, and name what they show."""

import re
from importlib.resources import files

import pytest
from tests.report.test_page import Elements

from derender.report.viewer.app import PAGE_FILES

PAGE = {name: (files("derender.report.viewer") / "page" / name).read_text() for name in PAGE_FILES}


def test_every_file_of_the_page_is_served(client):
    for name, kind in PAGE_FILES.items():
        reply = client.get(f"/{name}".removesuffix("index.html"))
        assert reply.body.decode() == PAGE[name]
        assert reply.headers["content-type"].startswith(f"text/{kind}")


@pytest.mark.parametrize("name", PAGE)
def test_nothing_comes_from_elsewhere(name):
    assert not re.findall(r"https?://|//[a-z]+\.|@import|url\(", PAGE[name])


@pytest.mark.parametrize("name", PAGE)
def test_text_never_becomes_html(name):
    bad = r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(|new Function|\son\w+=|javascript:"
    assert not re.findall(bad, PAGE[name])


def test_what_is_shown_and_what_is_pressed_has_a_name():
    result = Elements(PAGE["index.html"]).found
    for tag, attributes in result:
        if tag == "img":
            assert "alt" in attributes
        if tag == "canvas":
            assert attributes["aria-label"]
    identifiers = [attributes["id"] for _, attributes in result if "id" in attributes]
    assert len(identifiers) == len(set(identifiers))
    asked = set(re.findall(r'\$\("([\w-]+)"\)', PAGE["view.js"]))
    assert asked <= set(identifiers)
    assert any(tag == "html" and attributes["lang"] == "en" for tag, attributes in result)
