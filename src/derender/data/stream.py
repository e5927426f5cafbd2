"""Images one after another, in a fixed order, named and not yet decoded, with the labels they bring."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from derender.data.layouts.layout import Table, number_column, text_column
from derender.data.source import Skipped

S = TypeVar("S", bound="Stream")
Value = str | int | float | bool | None  # one label of one image; None is unknown
_EXACT_IN_FLOAT32 = 1 << 24


@dataclass(frozen=True)
class Sample:
    """One image on its way.

    Attributes:
        read: gives its encoded bytes, or raises ValueError or OSError with the reason. Any thread may call
            it, once.
        share: how much of the stream lies before the next sample, 0..1; None where that is unknown.
        labels: value by column; a column that is not here is unknown for this image.
        box: the part of the image that is read (``Table.boxes``), or None for all of it.
        size: gives the number of these bytes, 0 where they are in memory already.
        fit: what becomes of it if it is not square and its reader does not say.
    """

    file: str  # its name, unique in the stream
    read: Callable[[], bytes]
    share: float | None = None
    labels: Mapping[str, Value] = field(default_factory=dict)
    partition: str = ""  # the owners' own split ("train", "validation", "test"), or ""
    box: np.ndarray | None = None
    fit: str = "crop"
    size: Callable[[], int] = int


class Stream(ABC):
    """Samples in a fixed order."""

    source: str  # what the user named
    layout: str  # "webdataset", "huggingface", or the layout of a folder or zip
    terms: str = ""  # on what terms the owners of a published set give it, in a few words
    passed_over: tuple[Skipped, ...] = ()  # files that are known beforehand to be no use
    limit: int | None = None  # read only the first so many samples; None for all

    @property
    def table(self) -> Table | None:
        """Names and labels of every sample where they are known beforehand; None: each brings its own."""
        return None

    @abstractmethod
    def samples(self, start: int = 0) -> Iterator[Sample]:
        """The samples from number ``start`` on; of one that cannot be read, ``read`` raises."""

    @abstractmethod
    def identity(self) -> object:
        """Something whose ``repr`` changes when the content does (sizes, times, a revision)."""

    @property
    def place(self) -> str:
        """Where it is, the same from every folder one may work in."""
        return str(Path(self.source).absolute())

    def close(self) -> None:  # noqa: B027  (most hold nothing open)
        """Release what the stream holds open."""

    def __enter__(self: S) -> S:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def unreadable(reason: str) -> Callable[[], bytes]:
    """A ``Sample.read`` of an image that is known to be no use."""

    def refuse() -> bytes:
        raise ValueError(reason)

    return refuse


def label_name(name: str) -> str:
    """A column's name as a label: ``file`` is taken by our own names, so it becomes ``original_file``."""
    return "original_file" if name == "file" else name


class Kinds(dict[str, str | None]):
    """What each column of labels holds so far: "text", "number", "flag", or None while all is unknown.

    A column of several kinds is text, and so are whole numbers that float32 cannot hold (above 2^24:
    identifiers, as a rule).
    """

    def see(self, labels: Mapping[str, Value]) -> None:
        """Take one image's labels into account."""
        for name, value in labels.items():
            kind, known = None, self.get(name)
            if isinstance(value, bool):
                kind = "flag"
            elif value is not None:
                large = isinstance(value, str) or (isinstance(value, int) and abs(value) > _EXACT_IN_FLOAT32)
                kind = "text" if large else "number"
            self[name] = kind if known is None else known if kind in (None, known) else "text"


def column_of(name: str, rows: Iterable[Mapping[str, Value]], kind: str | None) -> np.ndarray:
    """One column of labels of a given kind; unknown values are "", NaN or -1."""
    values = [row.get(name) for row in rows]
    if kind == "number":
        return number_column(np.nan if value is None else float(value) for value in values)
    if kind == "flag":
        return np.array([-1 if value is None else int(value) for value in values], np.int8)
    return text_column("" if value is None else str(value) for value in values)
