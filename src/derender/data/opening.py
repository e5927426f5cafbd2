"""From what the user wrote to a stream of images; zip archives are read in place.

A path may be followed by ``::PART``: a part of the official split or any folder. Streams (shards, and data
sets of Hugging Face's library) are read from front to back. They take ``?column=NAME`` (also ``config``,
``revision``) before ``::PART``; others take ``?half=test`` or ``?half=development``. A path that exists is
always a path.

Members of a zip with absolute names or ``..`` in them, encrypted ones and those packed by bzip2 or LZMA are
passed over and listed. Refused are another size or CRC-32 than in the directory, and a size beyond
``FILE_LIMIT_BYTES``. So is a member that reaches into the next: members within each other let small archives
unpack to endless ones.
"""

import hashlib
import os
import re
import zipfile
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path, PurePosixPath
from urllib.parse import parse_qsl

import numpy as np
from jaxtyping import Int64

from derender.data.image import DECODER_ERRORS, HEAD_BYTES, LARGE_BYTES, Unreadable, refuse_by_header
from derender.data.layouts import layout_named, recognise
from derender.data.layouts.layout import Layout, Table, half_of
from derender.data.layouts.tables import TABLE_SUFFIXES, TableSource, holds_paths
from derender.data.source import (
    FILE_LIMIT_BYTES,
    FileSource,
    FolderSource,
    Skipped,
    Source,
    evenly_spaced,
    is_hidden,
    is_image,
)
from derender.data.stream import Sample, Stream
from derender.data.streamed import SHARD_SUFFIXES, HuggingFaceStream, ShardStream, find_shards, is_saved
from derender.storage.places import SUFFIXES, nearest_sibling, require_known

_HEADER_BYTES = 30
_ENCRYPTED = 1
_PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_HIDDEN = re.compile(r"(^|/)(\.(?!\.?(/|$))|__MACOSX(/|$))|/$|^$")
_UNSAFE = re.compile(r"^/|^[^/]*:|(^|/)\.\.(/|$)")


class ZipSource(Source):
    """The members of a zip that are neither hidden, unsafe, encrypted nor packed in a way of their own.

    Of two with one name the later.
    """

    def __init__(self, path: Path):
        self.path = path
        try:
            self._archive = zipfile.ZipFile(path)
        except DECODER_ERRORS as problem:
            raise ValueError(
                f"{path} is damaged or not a whole zip file ({problem}); download or copy it again"
            ) from problem
        self._members: dict[str, zipfile.ZipInfo] = {}
        faults: set[tuple[str, str]] = set()
        for member in self._archive.infolist():
            file = member.filename.replace("\\", "/")
            if _HIDDEN.search(file):
                continue
            if _UNSAFE.search(file):
                faults.add((file, "unsafe name in the zip (absolute or with ..)"))
            elif member.flag_bits & _ENCRYPTED:
                faults.add((file, "encrypted in the zip"))
            elif member.compress_type not in _PACKINGS:
                faults.add((file, "packed by bzip2, LZMA or the like: pack the zip by deflate, as usual"))
            else:
                self._members[file] = member
        self.files = tuple(sorted(self._members))
        self.skipped = tuple(Skipped(*fault) for fault in sorted(faults))
        begins = sorted({member.header_offset for member in self._archive.infolist()})
        self._following = dict(pairwise([*begins, self._archive.start_dir]))

    def read(self, file: str) -> bytes:
        member = self._members[file]
        size = member.file_size
        if size > FILE_LIMIT_BYTES:
            raise ValueError(f"unpacks to {size >> 20:,} MiB, more than {FILE_LIMIT_BYTES >> 20:,} MiB")
        end = member.header_offset + _HEADER_BYTES + len(member.orig_filename) + member.compress_size
        try:
            if end > self._following[member.header_offset]:
                raise ValueError("it reaches into what comes after it")
            with self._archive.open(member) as stream:
                content = stream.read(min(size, HEAD_BYTES))
                if size > LARGE_BYTES and is_image(file):
                    refuse_by_header(content, size)
                content += stream.read(size - len(content))  # without a number it would never end
            if len(content) != size:
                raise ValueError("it is shorter than the directory says")
        except Unreadable:
            raise
        except DECODER_ERRORS as problem:
            raise ValueError(f"cannot be unpacked: {problem}") from problem
        return content

    def stamps(self, files: Sequence[str]) -> Int64[np.ndarray, "n 2"]:
        members = (self._members[file] for file in files)
        return np.array([(one.file_size, one.CRC) for one in members], np.int64).reshape(-1, 2)

    def close(self) -> None:
        self._archive.close()


STREAMED = ("webdataset", "huggingface")
"""The layouts that are read from front to back, by the names one can ask for them."""

_IDENTIFIER = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")
_OPTIONS = ("column", "config", "revision", "half")
_ENTRIES_LOOKED_AT = 10_000


class ListedStream(Stream):
    """The images of ``files``, a folder, zip or table, in the order of its layout; it closes them."""

    def __init__(
        self, files: Source, layout: Layout, table: Table, subset: str | None = None, half: str = "all"
    ):
        self.files = files
        self.layout, self.terms, self.fit = layout.name, layout.terms, layout.fit
        self.table: Table = table  # pyright: ignore[reportIncompatibleVariableOverride]
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
    place, part, options = parse_source(source)
    path = Path(place).expanduser()
    kind = _kind_of(path, place) if dataset == "auto" else dataset
    if kind not in STREAMED:
        return list_images(source, dataset=dataset, subset=subset, limit=limit)
    part = _only_part(source, part, subset)
    if kind == "webdataset":
        if set(options) - {"column"}:
            raise ValueError(f"{source}: shards take ?column=NAME only")
        stream = ShardStream(str(source), find_shards(path, str(source), part), options.get("column"))
    elif path.exists():
        stream = HuggingFaceStream(str(source), path, split=part, **options)
    elif _IDENTIFIER.fullmatch(place):
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
    place, part, options = parse_source(source)
    subset = _only_part(source, part, subset)
    files = open_source(Path(place).expanduser())
    try:
        half = half_named(source, options)
        layout = layout or recognise(files)
        table = half_of(layout.read(files, subset), half)
        if not table.files:
            raise ValueError(_nothing_found(files))
    except BaseException:
        files.close()
        raise
    if limit is not None and limit < len(table.files):
        table = table.select(evenly_spaced(len(table.files), limit))
    return ListedStream(files, layout, table, subset, half)


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
    raise ValueError(
        f"{path} is no folder, zip or image ({' '.join(SUFFIXES)}); unpack other archives into a folder"
    )


def parse_source(source: str | Path) -> tuple[str, str | None, dict[str, str]]:
    """Place, part and options of ``PLACE?column=NAME::PART``; a path that exists as written is all place."""
    if not isinstance(source, str | Path):
        raise TypeError(
            f"expected a folder, zip, shards or Hugging Face id, got {type(source).__name__}: "
            "arrays and Pillow images go to model.embed or model.decompose"
        )
    text = str(source)
    if Path(text).expanduser().exists():
        return text, None, {}
    left, separator, part = text.rpartition("::")
    if not separator:
        left, part = text, ""
    elif not left or not part:
        raise ValueError(f"{text} should read PATH::SUBSET, with both parts")
    place, _, query = left.partition("?")
    if not query or Path(left).expanduser().exists():
        return left, part or None, {}
    options = dict(parse_qsl(query, keep_blank_values=True))
    for name in options:
        require_known(f"option of {text}", name, _OPTIONS)
    return place, part or None, options


def _only_part(source: str | Path, part: str | None, subset: str | None) -> str | None:
    if part is not None and subset is not None and part != subset:
        raise ValueError(f"{source} names the part {part!r}, but subset={subset!r} was given too; give one")
    return subset if part is None else part


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
    return "huggingface" if _IDENTIFIER.fullmatch(written) and not a_file else None


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
