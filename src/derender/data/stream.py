"""Images one after another, in a fixed order, named, with the labels they bring; and decoded on every core.

A pool decodes (Pillow does so without Python's lock) while whoever takes the results computes. The bound
counts images, so that memory does not grow with the stream.
"""

import hashlib
import os
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, field
from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from derender.data.image import LARGE_BYTES, Unreadable, decode, one_large_image_at_a_time
from derender.data.layouts.layout import Table, text_column
from derender.data.source import Closing, Skipped

Value = str | int | float | bool | None  # one label of one image; None is unknown
Progress = Callable[[int, int], object]  # called with (done, total), from the calling thread
CHUNK = 32  # images that one thread decodes before it hands them on


@dataclass(frozen=True)
class Sample:
    """One image on its way."""

    file: str  # its name, unique in the stream
    read: Callable[[], bytes]  # its bytes, or ValueError or OSError with why not; any thread calls it, once
    share: float | None = None  # how much of the stream lies before the next sample, 0..1; None: unknown
    labels: Mapping[str, Value] = field(default_factory=dict)  # by column; one that is not here is unknown
    partition: str = ""  # the owners' own split ("train", "validation", "test"), or ""
    box: np.ndarray | None = None  # the part that is read (``Table.boxes``), or None for all of it
    fit: str = "crop"  # what becomes of it if it is not square and its reader does not say
    size: Callable[[], int] = int  # gives the number of these bytes, 0 where they are in memory already


class Stream(Closing, ABC):
    """Samples in a fixed order."""

    source: str  # what the user named
    layout: str  # "webdataset", "huggingface", or the layout of a folder or zip
    terms: str = ""  # on what terms the owners of a published set give it, in a few words
    passed_over: tuple[Skipped, ...] = ()  # files that are known beforehand to be no use
    limit: int | None = None  # read only the first so many samples; None for all
    table: Table | None = None  # of every sample where that is known beforehand; None: each brings its labels

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


def unreadable(reason: str) -> bytes:
    """With its reason given, the ``Sample.read`` of an image that is known to be no use."""
    raise ValueError(reason)


def kinds_of(rows: Iterable[Mapping[str, Value]]) -> dict[str, str | None]:
    """What each column of labels holds: "text", "number", "flag", or None where all is unknown.

    A column of several kinds is text, and so are whole numbers above 2^24, which float32 cannot hold.
    """
    kinds: dict[str, str | None] = {}
    for name, value in chain.from_iterable(row.items() for row in rows):
        kind, known = None, kinds.get(name)
        if isinstance(value, bool):
            kind = "flag"
        elif value is not None:
            large = isinstance(value, str) or (isinstance(value, int) and abs(value) > 2**24)
            kind = "text" if large else "number"
        kinds[name] = kind if known is None else known if kind in (None, known) else "text"
    return kinds


def column_of(values: Iterable[Value], kind: str | None) -> np.ndarray:
    """One column of labels of a given kind; unknown values are "", NaN or -1."""
    if kind == "number":
        return np.array([np.nan if value is None else float(value) for value in values], np.float32)
    if kind == "flag":
        return np.array([-1 if value is None else int(value) for value in values], np.int8)
    return text_column("" if value is None else str(value) for value in values)


class Decoded(NamedTuple):
    """A decoded sample."""

    number: int  # its place in the stream
    file: str
    pixels: UInt8[np.ndarray, "3 s s"] | None  # RGB; None: unreadable, or needed no more
    outcome: bytes | Unreadable  # the digest of the pixels, or why there are none
    labels: Mapping[str, Value]  # a column ``file`` is ``original_file`` here: that name is taken
    partition: str
    share: float | None  # how much of the stream has been read, 0..1; None where that is unknown


def usable_cores() -> int:
    """The cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def decoded(
    stream: Stream, image_size: int, *, fit: str = "crop", start: int = 0, workers: int | None = None
) -> Generator[list[Decoded]]:
    """Decode from ``start`` to the stream's limit, in chunks, in ``quiet_pillow``; closing ends threads."""
    cores = workers or usable_cores()
    samples = islice(stream.samples(start), None if stream.limit is None else max(0, stream.limit - start))
    waiting: deque[Future[list[Decoded]]] = deque()
    pool = ThreadPoolExecutor(cores, thread_name_prefix="decode")
    try:
        while chunk := list(islice(samples, CHUNK)):
            waiting.append(pool.submit(decode_samples, start, chunk, image_size, fit))
            start += len(chunk)
            if len(waiting) > max(16, 2 * cores):
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def decode_samples(start: int, samples: Iterable[Sample], image_size: int, fit: str) -> list[Decoded]:
    """Decode consecutive samples, the first of them number ``start``, in this thread."""
    result = []
    for number, sample in enumerate(samples, start):
        pixels = None
        try:
            with one_large_image_at_a_time if sample.size() > LARGE_BYTES else nullcontext():
                if not (encoded := sample.read()):
                    raise Unreadable("empty file")
                pixels = decode(encoded, image_size, sample.fit if fit == "crop" else fit, sample.box)
                del encoded
            outcome = hashlib.blake2b(pixels.data, digest_size=16).digest()
        except ValueError as problem:
            outcome = Unreadable(str(problem))
        except OSError as problem:
            outcome = Unreadable(f"cannot be read: {problem.strerror or problem}")
        labels = {"original_file" if name == "file" else name: one for name, one in sample.labels.items()}
        result.append(Decoded(number, sample.file, pixels, outcome, labels, sample.partition, sample.share))
    return result


def estimated_total(done: int, share: float | None, limit: int | None) -> int:
    """How many samples there will be, judged by the share of the stream that ``done`` of them took."""
    total = done if not share else max(done, round(done / share))
    return total if limit is None else min(total, limit)
