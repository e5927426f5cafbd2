"""From what the user wrote to a stream, or to none: then it is a folder, a zip or a picture.

``shards-{000..009}.tar``, a single ``.tar``, a folder of them, ``owner/name`` of a Hugging Face data set, a
folder or ``.parquet`` in one of the forms of its library; each with ``::PART`` and ``?column=NAME`` (also
``config``, ``revision``) behind it. A path that exists is always a path.
"""

import os
import re
from collections.abc import Iterator
from itertools import islice, product
from pathlib import Path
from urllib.parse import parse_qsl

from derender.data.names import suggestion
from derender.data.source import is_hidden, is_picture, nearest_sibling
from derender.data.stream.huggingface import HuggingFaceStream, is_saved
from derender.data.stream.sample import Stream
from derender.data.stream.shards import SUFFIXES, ShardStream, find_shards, part_of_shards
from derender.data.tables import holds_paths

STREAMS = ("webdataset", "huggingface")
"""The layouts of streams, by the names one can ask for them."""

_IDENTIFIER = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")
_RANGE = re.compile(r"(\d+)\.\.(\d+)")
_OPTIONS = ("column", "config", "revision")
_ENTRIES_LOOKED_AT = 10_000
_MOST_SHARDS = 1_000_000


def open_stream(source: str | Path, *, dataset: str = "auto", subset: str | None = None) -> Stream | None:
    """The stream that a source is, or None if it is a folder, zip or picture.

    Args:
        source: what the user wrote.
        dataset: "webdataset" or "huggingface" to insist on one; any other layout but "auto" is no stream.
        subset: the part, if it is not in ``source``.
    """
    if dataset not in ("auto", *STREAMS):
        return None
    place, options, named = _parsed(str(source))
    if named is not None and subset is not None and named != subset:
        raise ValueError(f"{source} names the part {named!r}, but subset={subset!r} was given too; give one")
    subset = subset if named is None else named
    path = Path(place).expanduser()
    kind = dataset if dataset != "auto" else _kind_of(path, place)
    if kind is None:
        return None
    if kind == "webdataset":
        if set(options) - {"column"}:
            raise ValueError(f"{source}: shards take ?column=NAME only")
        shards = _shards(path, str(source))
        if subset is not None:
            shards = part_of_shards(shards, subset, place)
        return ShardStream(str(source), shards, options.get("column"))
    if path.exists():
        return HuggingFaceStream(str(source), path, split=subset, **options)
    if not _IDENTIFIER.fullmatch(place):
        raise ValueError(f"{place!r} is no folder here and no id of a Hugging Face data set (OWNER/NAME)")
    try:
        return HuggingFaceStream(str(source), place, split=subset, **options)
    except ValueError as problem:
        raise ValueError(f"{place} does not exist here{nearest_sibling(path)}; and {problem}") from problem


def expand_braces(pattern: str) -> Iterator[str]:
    """``a-{00..02}.tar`` to its three names, ``{x,y}`` to two; numbers keep the width they are written in."""
    pieces = re.split(r"\{([^{}]*)\}", pattern)
    choices = [[piece] if place % 2 == 0 else _choices(piece, pattern) for place, piece in enumerate(pieces)]
    for chosen in product(*choices):
        yield "".join(chosen)


def _choices(inner: str, pattern: str) -> list[str]:
    numbers = _RANGE.fullmatch(inner)
    if numbers is None:
        if "," in inner:
            return inner.split(",")
        raise ValueError(f"{{{inner}}} in {pattern} should read {{000..009}} or {{a,b}}")
    first, last = int(numbers[1]), int(numbers[2])
    if last < first or last - first >= _MOST_SHARDS:
        raise ValueError(f"{{{inner}}} in {pattern} should count up, to at most {_MOST_SHARDS:,} names")
    width = len(numbers[1]) if numbers[1].startswith("0") else 0
    return [f"{number:0{width}d}" for number in range(first, last + 1)]


def _parsed(text: str) -> tuple[str, dict[str, str], str | None]:
    """Place, options and part of ``PLACE?column=NAME::PART``; a path that exists is all place."""
    if Path(text).expanduser().exists():
        return text, {}, None
    left, separator, part = text.rpartition("::")
    if not separator:
        left, part = text, ""
    place, question, query = left.partition("?")
    if not question or (Path(left).expanduser().exists()):
        return left, {}, part if separator else None
    options = dict(parse_qsl(query, keep_blank_values=True))
    for name in options:
        if name not in _OPTIONS:
            raise ValueError(
                f"{text}: unknown option {name!r}{suggestion(name, _OPTIONS)} (known: {', '.join(_OPTIONS)})"
            )
    return place, options, part if separator else None


def _kind_of(path: Path, written: str) -> str | None:
    """Which stream a place looks like: by its name as written, and a folder by the first files in it."""
    if path.is_dir():
        return _kind_of_folder(path)
    if path.exists():
        name = path.name.lower()
        if name.endswith(SUFFIXES):
            return "webdataset"
        return "huggingface" if name.endswith(".parquet") and not holds_paths(path) else None
    if "{" in str(path) and str(path).endswith(SUFFIXES):
        return "webdataset"
    return "huggingface" if _could_be_identifier(written) else None


def _could_be_identifier(text: str) -> bool:
    known = (".zip", ".parquet", ".csv", *SUFFIXES)
    return bool(_IDENTIFIER.fullmatch(text)) and not is_picture(text) and not text.lower().endswith(known)


def _kind_of_folder(folder: Path) -> str | None:
    """Shards or a library's files, if no picture lies among the first files in it."""
    if is_saved(folder):
        return "huggingface"
    kind = None
    for name in islice(_names(folder), _ENTRIES_LOOKED_AT):
        if is_picture(name):
            return None
        if name.lower().endswith(SUFFIXES):
            kind = kind or "webdataset"
        elif name.lower().endswith(".parquet"):
            kind = kind or "huggingface"
    return kind


def _names(folder: Path) -> Iterator[str]:
    """Names of the files below a folder, its own first, no more of them looked up than are taken."""
    waiting = [str(folder)]
    while waiting:
        try:
            with os.scandir(waiting.pop(0)) as entries:
                for entry in entries:
                    if entry.is_dir(follow_symlinks=False):
                        waiting += [] if is_hidden(entry.name) else [entry.path]
                    else:
                        yield entry.name
        except OSError:  # whoever reads the folder says what is wrong with it
            continue


def _shards(path: Path, source: str) -> list[Path]:
    if path.is_dir():
        shards = find_shards(path)
        if not shards:
            raise ValueError(f"{path} holds no shards ({' '.join(SUFFIXES)})")
        return shards
    if path.exists():
        return [path]
    shards = [Path(name) for name in expand_braces(str(path))]
    absent = [shard for shard in shards if not shard.is_file()]
    if absent:
        raise ValueError(
            f"{len(absent):,} of the {len(shards):,} shards of {source} do not exist; "
            f"the first is {absent[0]}"
        )
    return shards
