"""A Hugging Face data set, streamed: by its id, or as files that the `datasets` library wrote.

The image column is found by its type. Class labels become text; texts, numbers and yes/no stay as they are;
other columns are not read. Nothing but the rows in hand is kept. The library is optional: ``pip install
'derender[huggingface]'``.

Not tried against the Hub itself: what is tested are folders in the forms in which the Hub keeps data sets.
"""

import importlib
import os
from collections.abc import Iterator
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

from derender.data.layouts.layout import PARTITION_NAMES
from derender.data.source import FILE_LIMIT_BYTES, printable, stamps_of
from derender.data.stream import Sample, Stream, label_name, unreadable
from derender.storage.bounded import read_bounded
from derender.storage.places import suggestion

_ANSWER_SECONDS = 10.0
_LABEL_KINDS = ("string", "large_string", "int", "uint", "float", "bool")


class HuggingFaceStream(Stream):
    """The rows of one split, or of all ("all"), of a folder, .parquet file or id "owner/name".

    None takes the split "train" or the only one there is, and the only image column and configuration.
    ``revision`` (of an id) is a branch, tag or commit; ``source`` is what the user named, for messages.
    """

    layout = "huggingface"

    def __init__(
        self,
        source: str,
        place: str | Path,
        *,
        split: str | None = None,
        column: str | None = None,
        config: str | None = None,
        revision: str | None = None,
    ):
        try:
            import datasets
        except ImportError as problem:
            raise ValueError(
                f"reading {source} as a Hugging Face data set needs the package datasets: "
                "pip install 'derender[huggingface]'"
            ) from problem
        self.source = source
        self._where = place
        self._options = (split, column, config)
        self._revision = revision if isinstance(place, Path) else _commit(place, revision)
        splits = _load(source, place, config, self._revision)
        part = split or ("train" if "train" in splits else next(iter(splits)) if len(splits) == 1 else "")
        if part not in ("all", *splits):
            hint = f"it has no split {part!r}{suggestion(part, splits)}" if part else "name one of its splits"
            raise ValueError(f"{source}: {hint}; there are {', '.join(splits)}, and all of them as ::all")
        names = list(splits) if part == "all" else [part]
        self._column, self._labels = _columns(splits[names[0]], column, source)
        self._counts = {name: _count(splits[name]) for name in names}
        self._splits: dict[str, Any] = {}
        for name in names:  # these columns only, images as encoded bytes
            rows = splits[name].select_columns([self._column, *self._labels])
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
        known = [count for count in self._counts.values() if count is not None]
        total = sum(known) if len(known) == len(self._counts) else 0
        before = 0
        for name, rows in self._splits.items():
            first = min(self._counts[name] or 0, max(0, start - before))
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
        if content is not None:
            read = partial(bytes, content)
        else:
            read = partial(_read_path, path, self._where) if path else unreadable("no image in this row")
        labels = {}
        for column, feature in self._labels.items():
            value, names = values[column], getattr(feature, "names", None)
            if names is not None and value is not None:
                value = names[value] if 0 <= value < len(names) else None
            labels[label_name(column)] = value
        return Sample(name, read, share, labels, PARTITION_NAMES.get(split.lower(), ""))


def _commit(identifier: str, revision: str | None) -> str:
    """The commit that an id stands for now; asked for first because the library itself retries for long."""
    from huggingface_hub import HfApi, errors

    try:
        return HfApi().dataset_info(identifier, revision=revision, timeout=_ANSWER_SECONDS).sha or "main"
    except errors.GatedRepoError as problem:
        terms = f"https://huggingface.co/datasets/{identifier}"
        fault = f"{identifier} is gated: accept its terms at {terms} and log in with 'hf auth login'"
        raise ValueError(f"the data set {fault}") from problem
    except errors.RepositoryNotFoundError as problem:
        fault = f"no data set {identifier} (or it is private): check the id, or log in"
        raise ValueError(f"the Hugging Face Hub has {fault}") from problem
    except errors.HFValidationError as problem:
        raise ValueError(f"{identifier!r} is no id of a Hugging Face data set") from problem
    except Exception as problem:  # what a broken connection raises changes with the client's HTTP library
        fault = f"cannot be asked for {identifier} ({type(problem).__name__}): check the network"
        raise ValueError(f"the Hugging Face Hub {fault}") from problem


def _load(source: str, place: str | Path, config: str | None, revision: str | None) -> dict[str, Any]:
    """Every split as a data set that has read nothing yet."""
    datasets: Any = importlib.import_module("datasets")

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
        left, separator, right = source.partition("::")
        raise ValueError(
            f"{source} has several columns of images ({', '.join(images)}); "
            f"name one: '{left}?column={images[0]}{separator}{right}'"
        )
    if column is not None and column not in images:
        hint = suggestion(column, images)
        raise ValueError(f"{source} has no column of images {column!r}{hint}; there is {', '.join(images)}")

    labels = {}
    for name, one in features.items():
        plain = isinstance(one, datasets.Value) and one.dtype.startswith(_LABEL_KINDS)
        if plain or isinstance(one, datasets.ClassLabel):
            labels[name] = one
    return column or images[0], labels


def _count(rows: Any) -> int | None:
    """The number of rows, where it is known without reading them."""
    known = (rows.info.splits or {}).get(str(rows.split))
    return getattr(rows, "num_rows", None) or getattr(known, "num_examples", None) or None


def _read_path(path: str, place: str | Path) -> bytes:
    """An image that the row only points at: on the Hub, or inside the local data set; never elsewhere."""
    if "://" in path:
        import fsspec

        with fsspec.open(path, "rb") as stream:
            return stream.read()  # pyright: ignore[reportAttributeAccessIssue]
    if isinstance(place, Path):
        inside = place if place.is_dir() else place.parent
        file = inside / path
        if file.resolve().is_relative_to(inside.resolve()) and file.is_file():
            return read_bounded(file, FILE_LIMIT_BYTES)
    raise ValueError(f"the row holds no image, only the path {path!r}, which is not in the data set")


def is_saved(folder: Path) -> bool:
    """Whether a folder was written by ``save_to_disk``."""
    return (folder / "dataset_dict.json").is_file() or (
        (folder / "state.json").is_file() and (folder / "dataset_info.json").is_file()
    )
