"""Which names are images', which are hidden, and how odd bytes are written."""

import os

from hypothesis import given
from hypothesis import strategies as st

from derender.data.names import SUFFIXES, is_hidden, is_image, printable


@given(st.text("aG./pnjif", max_size=12))
def test_a_picture_has_a_stem_and_a_known_suffix(name):
    base = name.split("/")[-1]
    stem, dot, suffix = base.rpartition(".")
    assert is_image(name) == (bool(dot) and stem != "" and f".{suffix.lower()}" in SUFFIXES)


def test_pictures():
    names = ("a.png", "b/a.JPG", ".a.png", "b.c/a.jpeg", ".png", "b/.png", "a.png/b", "png", "a.png.txt", "")
    assert [is_image(name) for name in names] == [True] * 4 + [False] * 6


def test_hidden():
    names = (".a", "..", "__MACOSX", "a.b", "_MACOSX", "")
    assert [is_hidden(name) for name in names] == [True] * 3 + [False] * 3


def test_printable():
    odd = os.fsdecode(b"\xffa")
    assert (printable("a"), printable("ä"), printable(odd)) == ("a", "ä", "\\xffa")
