"""Data sets that are read from front to back: WebDataset shards, and data sets of Hugging Face's library.

Shards are tar files whose members belong together where their names agree up to the first dot. A ``.cls``
becomes the label ``class`` (as text). Texts, numbers and yes/no values of a ``.json`` object become labels of
their own; other members are passed over unread. Nothing is ever extracted, so no name in a shard can do harm.
A damaged shard gives what was read before the damage, then one unreadable sample that says so. Source: the
format as described at https://github.com/webdataset/webdataset; read with Python's tarfile.

Of a Hugging Face data set, by its id or as files that the library wrote, the image column is found by its
type. Class labels become text; texts, numbers and yes/no stay; other columns are not read. The library is
optional: ``pip install 'derender[huggingface]'``. Tested are folders in the forms in which the Hub keeps data
sets, not the Hub itself.
"""

import json
import lzma
import os
import re
import tarfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import accumulate, islice, product
from pathlib import Path, PurePosixPath
from typing import Any

from derender.data.layouts.layout import partition_named
from derender.data.source import is_hidden, is_image, printable, stamps_of
from derender.data.stream import Sample, Stream, Value, unreadable
from derender.storage.bounded import FILE_LIMIT_BYTES, read_bounded
from derender.storage.places import optional, suggestion

SHARD_SUFFIXES = (".tar", ".tar.gz", ".tgz", ".tar.bz2", ".tar.xz")  # ends of the names of shards

_LABELS = ("json", "cls")
_LABEL_KINDS = ("string", "large_string", "int", "uint", "float", "bool")  # types of Hugging Face's columns
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
                    tar.members = []  # pyrefly: ignore[missing-attribute]  (it would keep them all)
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
            what = f"{self.source}: the sample {group.key!r} in {shard.name} has several images"
            raise _several_columns(self.source, what, images)
        if not images and not fault:
            missing = "no image" if self.column is None else f"no {self.column!r}"
            fault = f"{missing} in this sample (it has {', '.join(group.content)})"
        partition = partition_named(_series(shard))
        if fault:
            return Sample(name, partial(unreadable, fault), share, partition=partition)
        read, labels = partial(bytes, group.content[images[0]] or b""), {}
        try:
            labels = _labels(group.content)
        except ValueError as problem:
            read = partial(unreadable, str(problem))
        return Sample(f"{name}.{images[0]}", read, share, labels, partition)


def find_shards(path: Path, source: str, part: str | None = None) -> list[Path]:
    """Shards of a part below a folder, sorted by path; a shard itself; or those of a pattern with braces."""
    if path.is_dir():
        result = (one for one in path.rglob("*") if one.name.endswith(SHARD_SUFFIXES) and one.is_file())
        if not (shards := sorted(result)):
            raise ValueError(f"{path} holds no shards ({' '.join(SHARD_SUFFIXES)})")
    else:
        shards = [path] if path.exists() else [Path(name) for name in expand_braces(str(path))]
    if absent := [shard for shard in shards if not shard.is_file()]:
        missing = f"{len(absent):,} of the {len(shards):,} shards of {source} do not exist"
        raise ValueError(f"{missing}; the first is {absent[0]}")
    if not (chosen := [shard for shard in shards if part is None or part in _series(shard)]):
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
                raise ValueError(f"{{{piece}}} in {pattern} must count up, to at most {_MOST_SHARDS:,} names")
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
        labels = {name: value for name, value in values.items() if isinstance(value, Value)}
    if (text := content.get("cls")) is not None:
        try:
            labels["class"] = text.decode("utf-8").strip()
        except UnicodeDecodeError as problem:
            raise ValueError("its .cls is not UTF-8 text") from problem
    return labels


class HuggingFaceStream(Stream):
    """The rows of one split, or of all ("all"), of a folder, .parquet file or id "owner/name".

    None takes the split "train" or the only one there is, and the only image column and configuration.
    ``revision`` (of an id) is a branch, tag or commit; ``source`` is what the user named, for messages.
    """

    layout = "huggingface"

    def __init__(
        self, source: str, place: str | Path, *, split: str | None = None, column: str | None = None,
        config: str | None = None, revision: str | None = None,
    ):  # fmt: skip
        datasets = optional("datasets", f"reading {source} as a Hugging Face data set", "huggingface")
        self.source, self._where = source, place
        self._options = (split, column, config)
        self._revision = revision if isinstance(place, Path) else _commit(place, revision)
        splits = _load(source, place, config, self._revision)
        part = split or ("train" if "train" in splits else next(iter(splits)) if len(splits) == 1 else "")
        if part not in ("all", *splits):
            hint = f"it has no split {part!r}{suggestion(part, splits)}" if part else "name one of its splits"
            raise ValueError(f"{source}: {hint}; there are {', '.join(splits)}, and all of them as ::all")
        names = list(splits) if part == "all" else [part]
        self._column, self._labels = _columns(splits[names[0]], column, source)
        self._counts: dict[str, int] = {}  # 0 where it is not known without reading
        self._splits: dict[str, Any] = {}
        for name in names:  # these columns only, images as encoded bytes
            rows = splits[name]
            known = getattr((rows.info.splits or {}).get(str(rows.split)), "num_examples", None)
            self._counts[name] = getattr(rows, "num_rows", None) or known or 0
            rows = rows.select_columns([self._column, *self._labels])
            rows = rows.cast_column(self._column, datasets.Image(decode=False))
            streamed = isinstance(rows, datasets.IterableDataset)
            self._splits[name] = rows if streamed else rows.to_iterable_dataset()

    def identity(self) -> object:
        place = self._where
        if not isinstance(place, Path):
            return place, self._revision, self._options
        files = [place] if place.is_file() else sorted(path for path in place.rglob("*") if path.is_file())
        return self._options, [str(file.resolve()) for file in files], stamps_of(files).tolist()

    @property
    def place(self) -> str:
        return super().place if isinstance(self._where, Path) else f"{self._where} {self._options}"

    def samples(self, start: int = 0) -> Iterator[Sample]:
        total = sum(self._counts.values()) if all(self._counts.values()) else 0
        before = 0
        for name, rows in self._splits.items():
            first = min(self._counts[name], max(0, start - before))
            row = first - 1
            for row, values in enumerate(rows.skip(first) if first else rows, first):
                if before + row >= start:
                    yield self._sample(name, row, values, (before + row + 1) / total if total else None)
            before += row + 1

    def _sample(self, split: str, row: int, values: dict[str, Any], share: float | None) -> Sample:
        image = values[self._column] or {}
        content, path = image.get("bytes"), image.get("path")
        name = f"{split}/{row:08d}"
        if path:
            name += f"-{printable(PurePosixPath(path.replace(os.sep, '/')).name)}"
        read = partial(_read_path, path, self._where) if content is None else partial(bytes, content)
        labels = {}
        for column, feature in self._labels.items():
            value, names = values[column], getattr(feature, "names", None)
            if names is not None and value is not None:
                value = names[value] if 0 <= value < len(names) else None
            labels[column] = value
        return Sample(name, read, share, labels, partition_named([split]))


def _commit(identifier: str, revision: str | None) -> str:
    """The commit that an id stands for now; asked for first because the library itself retries for long."""
    from huggingface_hub import HfApi, errors

    try:
        return HfApi().dataset_info(identifier, revision=revision, timeout=10.0).sha or "main"
    except Exception as problem:  # what a broken connection raises changes with the client's HTTP library
        hub = "the Hugging Face Hub"
        fault = f"{hub} cannot be asked for {identifier} ({type(problem).__name__}): check the network"
        if isinstance(problem, errors.GatedRepoError):
            terms = f"accept its terms at https://huggingface.co/datasets/{identifier}"
            fault = f"the data set {identifier} is gated: {terms} and log in with 'hf auth login'"
        elif isinstance(problem, errors.RepositoryNotFoundError):
            fault = f"{hub} has no data set {identifier} (or it is private): check the id, or log in"
        elif isinstance(problem, errors.HFValidationError):
            fault = f"{identifier!r} is no id of a Hugging Face data set"
        raise ValueError(fault) from problem


def _load(source: str, place: str | Path, config: str | None, revision: str | None) -> dict[Any, Any]:
    """Every split as a data set that has read nothing yet."""
    import datasets.exceptions

    try:
        if isinstance(place, Path) and is_saved(place):
            saved = datasets.load_from_disk(str(place))
            return dict(saved if isinstance(saved, dict) else {str(saved.split or "train"): saved})
        if isinstance(place, Path) and place.is_file():
            return dict(datasets.load_dataset("parquet", data_files=str(place), streaming=True))
        return dict(datasets.load_dataset(str(place), config, revision=revision, streaming=True))
    except (datasets.exceptions.DatasetsError, OSError, ValueError, LookupError, TypeError) as problem:
        reason = (str(problem).strip().splitlines() or [type(problem).__name__])[0]
        hint = "; name one of its configurations: 'OWNER/NAME?config=NAME'" if "Config name" in reason else ""
        raise ValueError(f"{source} cannot be read as a Hugging Face data set: {reason}{hint}") from problem


def _columns(rows: Any, column: str | None, source: str) -> tuple[str, dict[str, Any]]:
    """The image column, and the columns that are labels with their types."""
    import datasets

    # some forms tell their columns only when rows are read
    features = rows.features if rows.features is not None else rows._resolve_features().features or {}
    images = [name for name, feature in features.items() if isinstance(feature, datasets.Image)]
    if not images:
        kinds = {name: getattr(one, "dtype", None) or type(one).__name__ for name, one in features.items()}
        there = ", ".join(f"{name} ({kind})" for name, kind in kinds.items()) or "none"
        raise ValueError(f"{source} has no column of images; its columns are {there}")
    if column is None and len(images) > 1:
        raise _several_columns(source, f"{source} has several columns of images", images)
    if column is not None and column not in images:
        hint = suggestion(column, images)
        raise ValueError(f"{source} has no column of images {column!r}{hint}; there is {', '.join(images)}")
    scalars = (datasets.Value, datasets.ClassLabel)  # the numbers of classes are integers
    plain = {name: one for name, one in features.items() if isinstance(one, scalars)}
    labels = {name: one for name, one in plain.items() if one.dtype.startswith(_LABEL_KINDS)}
    return column or images[0], labels


def _read_path(path: str | None, place: str | Path) -> bytes:
    """An image that the row only points at: on the Hub, or inside the local data set; never elsewhere."""
    if not path:
        raise ValueError("no image in this row")
    if "://" in path:
        import fsspec

        with fsspec.open(path, "rb") as stream:
            return stream.read()  # pyrefly: ignore[missing-attribute]
    if isinstance(place, Path):
        inside = place if place.is_dir() else place.parent
        file = inside / path
        if file.resolve().is_relative_to(inside.resolve()) and file.is_file():
            return read_bounded(file, FILE_LIMIT_BYTES)
    raise ValueError(f"the row holds no image, only the path {path!r}, which is not in the data set")


def is_saved(folder: Path) -> bool:
    """Whether a folder was written by ``save_to_disk``."""
    marks = ("dataset_dict.json",), ("state.json", "dataset_info.json")
    return any(all((folder / name).is_file() for name in names) for names in marks)


def _several_columns(source: str, what: str, columns: list[str]) -> ValueError:
    """The error where ``what`` has several images; it shows how one column is named in the source."""
    left, separator, right = source.partition("::")
    example = f"'{left}?column={columns[0]}{separator}{right}'"
    return ValueError(f"{what} ({', '.join(columns)}); name one: {example}")
