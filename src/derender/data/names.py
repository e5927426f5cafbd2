"""Which names of files count, and the known name that an unknown one probably meant."""

from collections.abc import Iterable
from difflib import get_close_matches

SUFFIXES = (
    *(".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".webp", ".avif", ".bmp", ".gif"),
    *(".tif", ".tiff", ".ppm", ".pgm", ".pnm"),
)
"""File names that end in one of these are taken for images."""

_SUFFIXES = frozenset(SUFFIXES)


def is_image(file: str) -> bool:
    """Whether the name has an image's suffix; nothing but a suffix is no image's name."""
    dot = file.rfind(".")
    return dot > 0 and file[dot - 1] != "/" and file[dot:].lower() in _SUFFIXES


def is_hidden(name: str) -> bool:
    """Whether a file or folder of this name is left out."""
    return name.startswith(".") or name == "__MACOSX"


def printable(name: str) -> str:
    """The name with bytes that are not UTF-8 as backslash escapes, so that it can be stored anywhere."""
    return name if name.isascii() else _escaped(name)


def _escaped(name: str) -> str:
    escaped = name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
    return name if escaped == name else escaped


def suggestion(name: str, known: Iterable[str]) -> str:
    """``"; did you mean 'x'?"`` for the closest known name, or an empty string when nothing is close."""
    by_lower = {candidate.lower(): candidate for candidate in known}
    close = get_close_matches(name.lower(), by_lower, n=1, cutoff=0.5)
    return f"; did you mean {by_lower[close[0]]!r}?" if close else ""
