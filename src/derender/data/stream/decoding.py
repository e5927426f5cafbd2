"""Samples to pixels, in order, on every core, with a bounded number on the way.

A thread of its own reads the stream, a pool decodes (Pillow does so without Python's lock), and whoever takes
the results computes meanwhile. What is on the way is bounded by counts of pictures, so memory does not grow
with the stream.
"""

import threading
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from queue import Empty, Full, Queue
from typing import TypeVar

import numpy as np
from jaxtyping import UInt8

from derender.data.decode import Unreadable, decode
from derender.data.duplicates import pixel_digest
from derender.data.loading import usable_cores
from derender.data.stream.sample import Sample, Stream, Value

T = TypeVar("T")

CHUNK = 32
"""Pictures that one thread decodes before it hands them on."""

_PATIENCE_SECONDS = 0.05


@dataclass(frozen=True)
class Decoded:
    """A few consecutive samples.

    Attributes:
        start: the number of the first one in the stream.
        files: their names.
        images: (n, 3, S, S) RGB; rows of unreadable pictures are waste.
        outcomes: the digest of the pixels, or why there are none.
        labels: of each sample.
        partitions: of each sample.
        share: how much of the stream has been read, 0..1; None where nobody knows.
    """

    start: int
    files: tuple[str, ...]
    images: UInt8[np.ndarray, "n 3 s s"]
    outcomes: tuple[bytes | Unreadable, ...]
    labels: tuple[Mapping[str, Value], ...]
    partitions: tuple[str, ...]
    share: float | None

    def __len__(self) -> int:
        return len(self.files)


def decoded(
    stream: Stream,
    image_size: int,
    *,
    fit: str = "crop",
    start: int = 0,
    workers: int | None = None,
) -> Iterator[Decoded]:
    """Decode a stream from sample ``start`` on, up to its limit. Wrap in ``quiet_pillow``."""
    cores = workers or usable_cores()
    samples = islice(stream.samples(start), None if stream.limit is None else max(0, stream.limit - start))
    waiting: deque[Future[Decoded]] = deque()
    pool = ThreadPoolExecutor(cores, thread_name_prefix="decode")
    try:
        while chunk := list(islice(samples, CHUNK)):
            waiting.append(pool.submit(decode_samples, start, chunk, image_size, fit))
            start += len(chunk)
            if len(waiting) > 2 * cores:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def ahead(items: Iterable[T], depth: int = 4) -> Iterator[Iterator[T]]:
    """Run an iterable in a thread of its own, at most ``depth`` items ahead of whoever takes them.

    What it raises is raised where it is taken. Leaving the block ends the thread.
    """
    queue: Queue[tuple[bool, T | BaseException | None]] = Queue(depth)
    stop = threading.Event()

    def put(entry: tuple[bool, T | BaseException | None]) -> bool:
        while not stop.is_set():
            try:
                queue.put(entry, timeout=_PATIENCE_SECONDS)
            except Full:
                continue
            return True
        return False

    def run() -> None:
        iterator = iter(items)
        try:
            for item in iterator:
                if not put((True, item)):
                    break
            else:
                put((False, None))
        except BaseException as problem:
            put((False, problem))
        finally:
            if isinstance(iterator, Iterator) and hasattr(iterator, "close"):
                iterator.close()  # pyright: ignore[reportAttributeAccessIssue]

    def take() -> Iterator[T]:
        while True:
            more, item = queue.get()
            if more:
                yield item  # pyright: ignore[reportReturnType]
            elif item is None:
                return
            else:
                raise item  # pyright: ignore[reportGeneralTypeIssues]

    thread = threading.Thread(target=run, name="read", daemon=True)
    thread.start()
    try:
        yield take()
    finally:
        stop.set()
        while thread.is_alive():
            try:
                queue.get_nowait()
            except Empty:
                thread.join(_PATIENCE_SECONDS)


def decode_samples(start: int, samples: Sequence[Sample], image_size: int, fit: str = "crop") -> Decoded:
    """Decode consecutive samples, at least one, the first of them number ``start``, in this thread."""
    images = np.empty((len(samples), 3, image_size, image_size), np.uint8)
    return Decoded(
        start,
        tuple(sample.file for sample in samples),
        images,
        tuple(_decode_one(target, sample, fit) for target, sample in zip(images, samples, strict=True)),
        tuple(sample.labels for sample in samples),
        tuple(sample.partition for sample in samples),
        samples[-1].share,
    )


def _decode_one(target: np.ndarray, sample: Sample, fit: str) -> bytes | Unreadable:
    try:
        encoded = sample.read()
        if not encoded:
            return Unreadable("empty file")
        target[:] = decode(encoded, target.shape[-1], fit, sample.box)
    except Unreadable as problem:
        return problem
    except ValueError as problem:
        return Unreadable(str(problem))
    except OSError as problem:
        return Unreadable(f"cannot be read: {problem.strerror or problem}")
    return pixel_digest(target)
