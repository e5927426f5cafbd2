"""WebDataset: tar files whose members belong together where their names agree up to the first dot.

A ``.cls`` becomes the label ``class`` (as text). Texts, numbers and yes/no values of a ``.json`` object
become labels of their own; other members are passed over unread. Nothing is ever extracted, so no name in a
shard can do harm. A damaged shard gives what was read before the damage, then one unreadable sample that says
so.

Source: the format as described at https://github.com/webdataset/webdataset; read with Python's tarfile.
"""

import json
import lzma
import re
import tarfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import accumulate, islice, product
from pathlib import Path

from derender.data.layouts.layout import PARTITION_NAMES
from derender.data.source import FILE_LIMIT_BYTES, is_hidden, is_image, printable, stamps_of
from derender.data.stream import Sample, Stream, Value, label_name, unreadable

SHARD_SUFFIXES = (".tar", ".tar.gz", ".tgz", ".tar.bz2", ".tar.xz")
"""File names that end in one of these are taken for shards."""

_LABELS = ("json", "cls")
_BLOCK = 512
_DAMAGE = (tarfile.TarError, OSError, EOFError, zlib.error, lzma.LZMAError, ValueError, OverflowError)
_MOST_SHARDS = 1_000_000


@dataclass
class _Group:
    """One sample's members while they are read: contents by ending (None: passed over), and what is wrong."""

    key: str = ""
    content: dict[str, bytes | None] = field(default_factory=dict)
    fault: str = ""
    read_bytes: int = 0

    @property
    def images(self) -> list[str]:
        return [ending for ending, one in self.content.items() if one is not None and ending not in _LABELS]


class ShardStream(Stream):
    """Samples of one or more tar files, in order."""

    layout = "webdataset"

    def __init__(self, source: str, shards: list[Path], column: str | None = None):
        self.source, self.shards = source, shards  # what the user named, and what it stands for
        self.column = column  # the image to take where samples have several ("jpg", "input.png")

    def identity(self) -> object:
        return self.column, [str(shard.resolve()) for shard in self.shards], stamps_of(self.shards).tolist()

    def samples(self, start: int = 0) -> Iterator[Sample]:
        ends = [0, *accumulate(stamps_of(self.shards)[:, 0].tolist())]
        every = (
            self._sample(shard, group, (before + group.read_bytes) / max(1, ends[-1]))
            for shard, before in zip(self.shards, ends, strict=False)
            for group in self._groups(shard)
        )
        return islice(every, start, None)

    def _groups(self, shard: Path) -> Iterator[_Group]:
        """Members that belong together, in order; the last group may be the shard's damage."""
        group: _Group | None = None
        try:
            with shard.open("rb") as raw, tarfile.open(fileobj=raw, mode="r:*") as tar:
                while (member := tar.next()) is not None:
                    tar.members = []  # pyright: ignore[reportAttributeAccessIssue]  (it would keep them all)
                    folder, slash, base = printable(member.name).rpartition("/")
                    if not member.isreg() or member.issparse() or is_hidden(base):
                        continue
                    stem, _, ending = base.partition(".")  # "a/0001", "seg.png" for a/0001.seg.png
                    key, ending = f"{folder}{slash}{stem}", ending.lower()
                    if group is None or key != group.key or ending in group.content:
                        if group is not None:
                            yield group
                        group = _Group(key)
                    group.content[ending] = None
                    group.read_bytes = raw.tell()
                    self._take(group, ending, tar, member)
                assert tar.fileobj is not None
                tar.fileobj.seek(tar.offset)
                if tar.fileobj.read(_BLOCK) != bytes(_BLOCK):
                    raise tarfile.ReadError("no end mark")
        except _DAMAGE as problem:
            if group is not None and group.images:
                yield group
            why = str(problem) or type(problem).__name__
            group = _Group(fault=f"damaged or cut short, what comes before counts ({why})")
        if group is not None:
            yield group

    def _take(self, group: _Group, ending: str, tar: tarfile.TarFile, member: tarfile.TarInfo) -> None:
        """Read a member if it is needed: an image, the one that was asked for, or labels."""
        needed = is_image(f"x.{ending}") if self.column is None else ending == self.column
        if not needed and ending not in _LABELS:
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

    def _sample(self, shard: Path, group: _Group, share: float) -> Sample:
        name = printable(shard.name) + (f"/{group.key}" if group.key else "")
        images, fault = group.images, group.fault
        if len(images) > 1 and not fault:
            left, separator, right = self.source.partition("::")
            raise ValueError(
                f"{self.source}: the sample {group.key!r} in {shard.name} has several images "
                f"({', '.join(images)}); name one: '{left}?column={images[0]}{separator}{right}'"
            )
        if not images and not fault:
            missing = "no image" if self.column is None else f"no {self.column!r}"
            fault = f"{missing} in this sample (it has {', '.join(group.content)})"
        partition = next(filter(None, (PARTITION_NAMES.get(one.lower()) for one in _series(shard))), "")
        if fault:
            return Sample(name, unreadable(fault), share, partition=partition)
        read, labels = partial(bytes, group.content[images[0]] or b""), {}
        try:
            labels = _labels(group.content)
        except ValueError as problem:
            read = unreadable(str(problem))
        return Sample(f"{name}.{images[0]}", read, share, labels, partition)


def find_shards(path: Path, source: str, part: str | None = None) -> list[Path]:
    """The shards below a folder, sorted by path; a shard itself; or those of a pattern with braces.

    Of a part ``train`` are those called train-000.tar, and those in a folder of that name.
    """
    if path.is_dir():
        result = (one for one in path.rglob("*") if one.name.endswith(SHARD_SUFFIXES) and one.is_file())
        if not (shards := sorted(result)):
            raise ValueError(f"{path} holds no shards ({' '.join(SHARD_SUFFIXES)})")
    else:
        shards = [path] if path.exists() else [Path(name) for name in expand_braces(str(path))]
    absent = [shard for shard in shards if not shard.is_file()]
    if absent:
        missing = f"{len(absent):,} of the {len(shards):,} shards of {source} do not exist"
        raise ValueError(f"{missing}; the first is {absent[0]}")
    chosen = [shard for shard in shards if part is None or part in _series(shard)]
    if not chosen:
        known = sorted({name for shard in shards for name in _series(shard)})
        raise ValueError(f"{path} has no shards of a part {part!r}; there are {', '.join(known)}")
    return chosen


def expand_braces(pattern: str) -> Iterator[str]:
    """``a-{00..02}.tar`` to its three names, ``{x,y}`` to two; numbers keep the width they are written in."""
    choices: list[Iterable[str]] = []
    for place, piece in enumerate(re.split(r"\{([^{}]*)\}", pattern)):
        numbers = re.fullmatch(r"(\d+)\.\.(\d+)", piece)
        if place % 2 == 0:
            choices.append([piece])
        elif numbers is not None:
            first, last = int(numbers[1]), int(numbers[2])
            if last < first or last - first >= _MOST_SHARDS:
                raise ValueError(
                    f"{{{piece}}} in {pattern} should count up, to at most {_MOST_SHARDS:,} names"
                )
            width = len(numbers[1]) if numbers[1].startswith("0") else 0
            choices.append([f"{number:0{width}d}" for number in range(first, last + 1)])
        elif "," in piece:
            choices.append(piece.split(","))
        else:
            raise ValueError(f"{{{piece}}} in {pattern} should read {{000..009}} or {{a,b}}")
    return map("".join, product(*choices))


def _series(shard: Path) -> tuple[str, str]:
    """A shard's name without its number, "train" for train-000012.tar; and that of its folder."""
    stem = shard.name.partition(".tar")[0].removesuffix(".tgz")
    return re.sub(r"[-_.]?\d+(?:[-_]of[-_]\d+)?$", "", stem), shard.parent.name


def _labels(content: Mapping[str, bytes | None]) -> dict[str, Value]:
    labels: dict[str, Value] = {}
    if (text := content.get("json")) is not None:
        try:
            values = json.loads(text)
        except (ValueError, RecursionError) as problem:
            raise ValueError(f"its .json cannot be read ({problem})") from problem
        if not isinstance(values, dict):
            raise ValueError(f"its .json holds a {type(values).__name__}, expected an object")
        labels = {label_name(name): value for name, value in values.items() if isinstance(value, Value)}
    if (text := content.get("cls")) is not None:
        try:
            labels["class"] = text.decode("utf-8").strip()
        except UnicodeDecodeError as problem:
            raise ValueError("its .cls is not UTF-8 text") from problem
    return labels
