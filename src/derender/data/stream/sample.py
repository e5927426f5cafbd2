"""What a stream hands on: one picture at a time, named, not yet decoded."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from derender.data.layout import Table
from derender.data.source import Skipped

Value = str | int | float | bool | None
"""One label of one picture; None is unknown."""


@dataclass(frozen=True)
class Sample:
    """One picture on its way.

    Attributes:
        file: its name, unique in the stream.
        read: gives its encoded bytes, or raises ValueError or OSError with the reason. Any thread may call
            it, once.
        share: how much of the stream lies before the next sample, 0..1; None where nobody knows.
        labels: value by column; a column that is not here is unknown for this picture.
        partition: the owners' own split ("train", "validation", "test"), or "".
        box: the part of the picture that is read (data/layout.py), or None for all of it.
    """

    file: str
    read: Callable[[], bytes]
    share: float | None = None
    labels: Mapping[str, Value] = field(default_factory=dict)
    partition: str = ""
    box: np.ndarray | None = None


class Stream(ABC):
    """Samples in a fixed order.

    Attributes:
        source: what the user named.
        layout: "webdataset", "huggingface", or the layout of a folder or zip.
        table: names and labels of every sample where they are known beforehand, else None: then each sample
            brings its own.
        passed_over: files that are known beforehand to be no use.
        limit: read only the first so many samples; None for all.
    """

    source: str
    layout: str
    table: Table | None = None
    passed_over: tuple[Skipped, ...] = ()
    limit: int | None = None

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

    def __enter__(self) -> "Stream":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def unreadable(reason: str) -> Callable[[], bytes]:
    """A ``Sample.read`` for what is known to be no use."""

    def refuse() -> bytes:
        raise ValueError(reason)

    return refuse


def given(content: bytes) -> Callable[[], bytes]:
    """A ``Sample.read`` for bytes that are in memory already."""
    return lambda: content


def label_name(name: str) -> str:
    """A column's name as a label: ``file`` is taken by our own names, so it becomes ``original_file``."""
    return "original_file" if name == "file" else name
