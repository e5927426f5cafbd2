"""From what the user wrote to a stream of images.

A path may be followed by ``::PART``: a part of the official split or any folder. Streams (shards, and data
sets of Hugging Face's library) are read from front to back. They take ``?column=NAME`` (``config``,
``revision``) before ``::PART``; others ``?half=test`` or ``?half=development``. What exists is a path.
"""

import hashlib
import os
import zipfile
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path, PurePosixPath
from urllib.parse import parse_qsl

from derender.data.layouts import LAYOUTS, layout_named
from derender.data.layouts.layout import Layout, Table, half_of
from derender.data.layouts.tables import TABLE_SUFFIXES, TableSource, holds_paths
from derender.data.source import FileSource, FolderSource, Source, ZipSource, is_hidden, is_image
from derender.data.stream import Sample, Stream
from derender.data.streamed import SHARD_SUFFIXES, HuggingFaceStream, ShardStream, find_shards, is_saved
from derender.storage.places import SUFFIXES, hub_id, nearest_sibling, require_known

STREAMED = ("webdataset", "huggingface")  # layouts that are read from front to back, as one asks for them

_ENTRIES_LOOKED_AT = 10_000


class ListedStream(Stream):
    """The images of ``files``, a folder, zip or table, in the order of its layout; it closes them."""

    def __init__(self, files: Source, layout: Layout, table: Table, subset: str | None, half: str):
        self.files = files
        self.layout, self.terms, self.fit = layout.name, layout.terms, layout.fit
        self.table: Table = table
        self.source = str(files.path) + ("" if half == "all" else f"?half={half}")
        self.source += "" if subset is None else f"::{subset}"
        self.passed_over = (*files.skipped, *table.skipped)

    def samples(self, start: int = 0) -> Iterator[Sample]:
        table, count = self.table, len(self.table.files)
        for row in range(start, count):
            file, box = table.files[row], None if table.boxes is None else table.boxes[row]
            read, size = partial(self.files.read, file), partial(self.files.size, file)
            yield Sample(file, read, (row + 1) / count, box=box, fit=self.fit, size=size)

    def identity(self) -> object:
        """A digest of the layout, and of the name, size and checksum or time of change of every image."""
        files, boxes = self.table.files, self.table.boxes
        digest = hashlib.sha256(repr((self.layout, None if boxes is None else boxes.tobytes())).encode())
        for file, stamp in zip(files, self.files.stamps(files).tolist(), strict=True):
            digest.update(f"({file!r}, {stamp})".encode())
        return digest.hexdigest()

    def close(self) -> None:
        self.files.close()


def open_images(
    source: str | Path, *, dataset: str = "auto", subset: str | None = None, limit: int | None = None
) -> Stream:
    """Any source of images as a stream; close it after use.

    Args:
        source: what the user wrote.
        dataset: the layout's name, or "auto" to recognise it.
        subset: the part, if it is not in ``source``.
        limit: at most so many images: evenly spaced where it is known what there is, else the first.
    """
    place, part, options = parse_source(source, subset)
    path = Path(place).expanduser()
    kind = _kind_of(path, place) if dataset == "auto" else dataset
    if kind not in STREAMED:
        return list_images(source, dataset=dataset, subset=subset, limit=limit)
    if "half" in options:
        raise ValueError(f"{source}: ?half= is for folders, zips and tables, not for streams")
    if kind == "webdataset":
        if set(options) - {"column"}:
            raise ValueError(f"{source}: shards take ?column=NAME only")
        stream = ShardStream(str(source), find_shards(path, str(source), part), options.get("column"))
    elif path.exists():
        stream = HuggingFaceStream(str(source), path, split=part, **options)
    elif hub_id(place):
        try:
            stream = HuggingFaceStream(str(source), place, split=part, **options)
        except ValueError as problem:
            here = f"{place} does not exist here{nearest_sibling(path)}"
            raise ValueError(f"{here}; and {problem}") from problem
    else:
        raise ValueError(f"{place!r} is no folder here and no id of a Hugging Face data set (OWNER/NAME)")
    stream.limit = limit
    return stream


def list_images(
    source: str | Path, *, dataset: str = "auto", subset: str | None = None, limit: int | None = None
) -> ListedStream:
    """Open a folder, zip, image or table, recognise its layout (or take the one named), and read its labels.

    No image at all is an error that says what is there instead. The arguments are those of ``open_images``.
    """
    layout = None if dataset == "auto" else layout_named(dataset)
    place, subset, options = parse_source(source, subset)
    files = open_source(Path(place).expanduser())
    try:
        half = half_named(source, options)
        layout = layout or next(one for one in LAYOUTS if one.recognise(files))
        table = half_of(layout.read(files, subset), half)
        if not table.files:
            raise ValueError(_nothing_found(files))
    except BaseException:
        files.close()
        raise
    return ListedStream(files, layout, table.at_most(limit), subset, half)


def half_named(source: str | Path, options: dict[str, str]) -> str:
    """The half of a set that its address asks for; an option of other kinds of sets is a ValueError."""
    if others := sorted(options.keys() - {"half"}):
        raise ValueError(f"{source}: ?{others[0]}= is for shards and Hugging Face data sets")
    return options.get("half", "all")


def open_source(path: Path) -> Source:
    """Open a folder, zip, image or table; anything else is an error that says what to give instead."""
    if not path.exists():
        raise ValueError(f"{path} does not exist{nearest_sibling(path)}")
    if path.is_dir():
        return FolderSource(path)
    if path.is_file() and path.name.lower().endswith(TABLE_SUFFIXES):
        return TableSource(path)
    if is_image(path.name):
        return FileSource(path)
    if path.is_file() and (path.suffix.lower() == ".zip" or zipfile.is_zipfile(path)):
        return ZipSource(path)
    known = f"folder, zip or image ({' '.join(SUFFIXES)})"
    raise ValueError(f"{path} is no {known}; unpack other archives into a folder")


def parse_source(source: str | Path, subset: str | None = None) -> tuple[str, str | None, dict[str, str]]:
    """Place, part and options of ``PLACE?column=NAME::PART``; a path that exists as written is all place.

    A part that was named separately is ``subset``; another one in ``source`` is a ValueError.
    """
    if not isinstance(source, str | Path):
        expected = f"expected a folder, zip, shards or Hugging Face id, got {type(source).__name__}"
        raise TypeError(f"{expected}: arrays and Pillow images go to model.embed or model.decompose")
    text = str(source)
    if Path(text).expanduser().exists():
        return text, subset, {}
    left, _, part = text.rpartition("::") if "::" in text else (text, "", subset)
    if "::" in text and not (left and part):
        raise ValueError(f"{text} should read PATH::SUBSET, with both parts")
    if subset not in (None, part):
        raise ValueError(f"{source} names the part {part!r}, but subset={subset!r} was given too; give one")
    place, _, query = left.partition("?")
    if not query or Path(left).expanduser().exists():
        return left, part, {}
    options = dict(parse_qsl(query, keep_blank_values=True))
    for name in options:
        require_known(f"option of {text}", name, ("column", "config", "revision", "half"))
    return place, part, options


def _nothing_found(files: Source) -> str:
    """What was looked for, where, and what lies there instead."""
    kinds = Counter(PurePosixPath(file).suffix.lower() or "no suffix" for file in files.files)
    result = ", ".join(f"{count:,} of {kind}" for kind, count in kinds.most_common(5)) or "no files at all"
    hint = "; to read an archive in it, name that file itself" if ".zip" in kinds else ""
    if files.skipped:
        first = files.skipped[0]
        hint += f"; passed over {len(files.skipped):,}, the first is {first.file!r}: {first.reason}"
    return f"no images found in {files.path}: looked for {' '.join(SUFFIXES)}; found {result}{hint}"


def _kind_of(path: Path, written: str) -> str | None:
    """One of ``STREAMED`` by a place's name as written, or a folder's by the first files in it; or None."""
    name = path.name.lower()
    if path.is_dir():
        return "huggingface" if is_saved(path) else _kind_of_folder(path)
    if name.endswith(SHARD_SUFFIXES) and (path.exists() or "{" in str(path)):
        return "webdataset"
    if path.exists():
        return "huggingface" if name.endswith(".parquet") and not holds_paths(path) else None
    a_file = name.endswith((".zip", *TABLE_SUFFIXES, *SHARD_SUFFIXES, *SUFFIXES))
    return "huggingface" if hub_id(written) and not a_file else None


def _kind_of_folder(folder: Path) -> str | None:
    """Shards or a library's files, if no image lies among the first files in it."""
    kind, looked_at = None, 0
    for _, folders, names in os.walk(folder):
        if any(map(is_image, names)):
            return None
        for name in map(str.lower, names):
            streamed = "webdataset" if name.endswith(SHARD_SUFFIXES) else None
            kind = kind or streamed or ("huggingface" if name.endswith(".parquet") else None)
        folders[:] = [name for name in folders if not is_hidden(name)]
        if (looked_at := looked_at + len(names)) >= _ENTRIES_LOOKED_AT:
            break
    return kind
