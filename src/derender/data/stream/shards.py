"""WebDataset: tar files whose members belong together where their names agree up to the first dot.

``0001.jpg`` and ``0001.json`` are one sample. A ``.cls`` becomes the label ``class`` (as text), the texts,
numbers and yes/no values of a ``.json`` object become labels of their own; lists, objects and other members
are passed over unread. Shards are read from front to back, and nothing is ever extracted, so no name in them
can do harm. A damaged shard gives what was read before the damage, then one unreadable sample that says so.

Source: the format as described at https://github.com/webdataset/webdataset; read with Python's tarfile.
"""

import bz2
import gzip
import json
import lzma
import re
import tarfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path
from typing import IO, Any

from derender.data.layout import PARTITION_NAMES
from derender.data.source import FILE_LIMIT_BYTES, is_hidden, is_picture, printable
from derender.data.stream.sample import Sample, Stream, Value, given, label_name, unreadable

SUFFIXES = (".tar", ".tar.gz", ".tgz", ".tar.bz2", ".tar.xz")
"""File names that end in one of these are taken for shards."""

_LABELS = ("json", "cls")
_BLOCK = 512
_DAMAGE = (tarfile.TarError, OSError, EOFError, zlib.error, lzma.LZMAError, ValueError, OverflowError)


class ShardStream(Stream):
    """Samples of shards, one shard after the other.

    Args:
        source: what the user named, for messages.
        shards: the tar files, in order; at least one.
        column: which picture to take where samples have several ("jpg", "input.png"), or None.
    """

    layout = "webdataset"

    def __init__(self, source: str, shards: list[Path], column: str | None = None):
        self.source = source
        self.shards = shards
        self.column = column

    def identity(self) -> object:
        status = [shard.stat() for shard in self.shards]
        return self.column, [
            (str(shard.resolve()), one.st_size, one.st_mtime_ns)
            for shard, one in zip(self.shards, status, strict=True)
        ]

    def samples(self, start: int = 0) -> Iterator[Sample]:
        sizes = [shard.stat().st_size for shard in self.shards]
        total = max(1, sum(sizes))

        def all_of_them() -> Iterator[Sample]:
            before = 0
            for shard, size in zip(self.shards, sizes, strict=True):
                for group in self._groups(shard):
                    yield self._sample(shard, group, (before + group.read_bytes) / total)
                before += size

        yield from islice(all_of_them(), start, None)

    def _groups(self, shard: Path) -> Iterator["_Group"]:
        """Members that belong together, in order; the last group may be the shard's damage."""
        group: _Group | None = None
        try:
            with _opened(shard) as (tar, stream, raw):
                while (member := tar.next()) is not None:
                    tar.members = []  # pyright: ignore[reportAttributeAccessIssue]  (it would keep them all)
                    name = printable(member.name)
                    if not member.isreg() or member.issparse() or is_hidden(name.rpartition("/")[2]):
                        continue
                    key, ending = _parts(name)
                    if group is None or key != group.key or ending in group.endings:
                        if group is not None:
                            yield group
                        group = _Group(key)
                    group.endings.append(ending)
                    group.read_bytes = raw.tell()
                    self._take(group, ending, tar, member)
                stream.seek(tar.offset)
                if stream.read(_BLOCK) != bytes(_BLOCK):
                    raise tarfile.ReadError("no end mark")
        except _DAMAGE as problem:
            if group is not None and any(ending not in _LABELS for ending in group.content):
                yield group
            yield _Group("", fault=f"damaged or cut short, what comes before counts ({_why(problem)})")
            return
        if group is not None:
            yield group

    def _take(self, group: "_Group", ending: str, tar: tarfile.TarFile, member: tarfile.TarInfo) -> None:
        """Read a member if it is wanted: a picture, the one that was asked for, or labels."""
        wanted = is_picture(f"x.{ending}") if self.column is None else ending == self.column
        if not wanted and ending not in _LABELS:
            return
        if member.size > FILE_LIMIT_BYTES:
            group.fault = f"unpacks to {member.size >> 20:,} MiB, more than {FILE_LIMIT_BYTES >> 20:,} MiB"
            return
        opened = tar.extractfile(member)
        assert opened is not None
        content = opened.read()
        if len(content) != member.size:
            raise tarfile.ReadError("unexpected end of data")
        group.content[ending] = content

    def _sample(self, shard: Path, group: "_Group", share: float) -> Sample:
        if group.key == "" and group.fault:
            return Sample(printable(shard.name), unreadable(group.fault), share)
        pictures = [ending for ending in group.content if ending not in _LABELS]
        if len(pictures) > 1:
            raise ValueError(
                f"{self.source}: the sample {group.key!r} in {shard.name} has several pictures "
                f"({', '.join(pictures)}); name one: '{_with_column(self.source, pictures[0])}'"
            )
        name = f"{printable(shard.name)}/{group.key}"
        partial_sample = partial(Sample, share=share, partition=_partition(shard))
        if group.fault:
            return partial_sample(name, unreadable(group.fault))
        if not pictures:
            asked = "no picture" if self.column is None else f"no {self.column!r}"
            return partial_sample(
                name, unreadable(f"{asked} in this sample (it has {', '.join(group.endings)})")
            )
        name += f".{pictures[0]}"
        try:
            labels = _labels(group.content)
        except ValueError as problem:
            return partial_sample(name, unreadable(str(problem)))
        return partial_sample(name, given(group.content[pictures[0]]), labels=labels)


@dataclass
class _Group:
    """One sample's members while they are read."""

    key: str
    endings: list[str] = field(default_factory=list)
    content: dict[str, bytes] = field(default_factory=dict)
    fault: str = ""
    read_bytes: int = 0


@contextmanager
def _opened(shard: Path) -> Iterator[tuple[tarfile.TarFile, IO[bytes], IO[bytes]]]:
    """A shard as (tar, its unpacked stream, the file itself)."""
    with shard.open("rb") as raw:
        head = raw.read(6)
        raw.seek(0)
        with _unpacked(raw, head) as stream, tarfile.open(fileobj=stream, mode="r:") as tar:
            yield tar, stream, raw


def _unpacked(raw: IO[bytes], head: bytes) -> AbstractContextManager[IO[bytes]]:
    """The stream that a packed file holds, known by its first bytes; the file itself if it is not packed."""
    for mark, opener in _PACKINGS.items():
        if head.startswith(mark):
            return opener(raw)
    return nullcontext(raw)


_PACKINGS: dict[bytes, Callable[[IO[bytes]], Any]] = {
    b"\x1f\x8b": lambda raw: gzip.GzipFile(fileobj=raw),
    b"BZh": bz2.BZ2File,
    b"\xfd7zXZ": lzma.LZMAFile,
}


def find_shards(folder: Path) -> list[Path]:
    """Every shard below a folder, sorted by path."""
    return sorted(path for path in folder.rglob("*") if path.name.endswith(SUFFIXES) and path.is_file())


def part_of_shards(shards: list[Path], subset: str, source: str) -> list[Path]:
    """The shards of one part: ``train`` means train-000.tar, or what lies in a folder ``train``."""
    chosen = [shard for shard in shards if subset in (_series(shard), shard.parent.name)]
    if not chosen:
        known = sorted({_series(shard) for shard in shards} | {shard.parent.name for shard in shards})
        raise ValueError(f"{source} has no shards of a part {subset!r}; there are {', '.join(known)}")
    return chosen


def _series(shard: Path) -> str:
    """A shard's name without its number: "train" for train-000012.tar."""
    stem = shard.name[: shard.name.index(".tar")] if ".tar" in shard.name else shard.stem
    return re.sub(r"[-_.]?\d+(?:[-_]of[-_]\d+)?$", "", stem)


def _partition(shard: Path) -> str:
    for name in (_series(shard), shard.parent.name):
        if name.lower() in PARTITION_NAMES:
            return PARTITION_NAMES[name.lower()]
    return ""


def _parts(name: str) -> tuple[str, str]:
    """Key and ending of a member: ("a/0001", "seg.png") for a/0001.seg.png."""
    folder, slash, base = name.rpartition("/")
    stem, _, ending = base.partition(".")
    return f"{folder}{slash}{stem}", ending.lower()


def _labels(content: Mapping[str, bytes]) -> dict[str, Value]:
    labels: dict[str, Value] = {}
    if "json" in content:
        try:
            values = json.loads(content["json"])
        except (ValueError, RecursionError) as problem:
            raise ValueError(f"its .json cannot be read ({problem})") from problem
        if not isinstance(values, dict):
            raise ValueError(f"its .json holds a {type(values).__name__}, expected an object")
        labels = {
            label_name(name): value
            for name, value in values.items()
            if isinstance(value, str | int | float | None)
        }
    if "cls" in content:
        try:
            labels["class"] = content["cls"].decode("utf-8").strip()
        except UnicodeDecodeError as problem:
            raise ValueError("its .cls is not UTF-8 text") from problem
    return labels


def _with_column(source: str, column: str) -> str:
    left, separator, right = source.partition("::")
    return f"{left}?column={column}{separator}{right}"


def _why(problem: BaseException) -> str:
    return str(problem) or type(problem).__name__
