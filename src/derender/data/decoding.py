"""Samples to pixels, in order, on every core, a bounded number on the way.

A pool decodes (Pillow does so without Python's lock) while whoever takes the results computes. The bound
counts images, so that memory does not grow with the stream.
"""

import hashlib
import os
from collections import deque
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import islice

import numpy as np
from jaxtyping import UInt8

from derender.data.image import LARGE_BYTES, Unreadable, decode, one_large_image_at_a_time
from derender.data.stream import Sample, Stream, Value

Progress = Callable[[int, int], object]  # called with (images done, images in all), from the calling thread
CHUNK = 32  # images that one thread decodes before it hands them on
DIGEST_BYTES = 16


@dataclass(frozen=True)
class Decoded:
    """A few consecutive samples."""

    start: int  # the number of the first one in the stream
    files: tuple[str, ...]  # their names
    images: UInt8[np.ndarray, "n 3 s s"]  # (n, 3, S, S) RGB; rows of unreadable images are waste
    outcomes: tuple[bytes | Unreadable, ...]  # the digest of the pixels, or why there are none
    labels: tuple[Mapping[str, Value], ...]  # of each sample
    partitions: tuple[str, ...]  # of each sample
    share: float | None  # how much of the stream has been read, 0..1; None where that is unknown

    def __len__(self) -> int:
        return len(self.files)


def usable_cores() -> int:
    """The cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def decoded(
    stream: Stream, image_size: int, *, fit: str = "crop", start: int = 0, workers: int | None = None
) -> Generator[Decoded]:
    """Decode a stream from sample ``start`` on, up to its limit; close it to end its threads. Wrap in
    ``quiet_pillow``."""
    cores = workers or usable_cores()
    samples = islice(stream.samples(start), None if stream.limit is None else max(0, stream.limit - start))
    waiting: deque[Future[Decoded]] = deque()
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


def decode_samples(start: int, samples: Sequence[Sample], image_size: int, fit: str = "crop") -> Decoded:
    """Decode consecutive samples, at least one, the first of them number ``start``, in this thread."""
    images = np.empty((len(samples), 3, image_size, image_size), np.uint8)
    outcomes = tuple(_decode_one(target, sample, fit) for target, sample in zip(images, samples, strict=True))
    files, labels, parts = zip(*((one.file, one.labels, one.partition) for one in samples), strict=True)
    return Decoded(start, files, images, outcomes, labels, parts, samples[-1].share)


def _decode_one(target: np.ndarray, sample: Sample, fit: str) -> bytes | Unreadable:
    """Decode one sample into its row and digest its pixels, or say why that cannot be done."""
    try:
        with one_large_image_at_a_time if sample.size() > LARGE_BYTES else nullcontext():
            if not (encoded := sample.read()):
                return Unreadable("empty file")
            target[:] = decode(encoded, target.shape[-1], sample.fit if fit == "crop" else fit, sample.box)
            del encoded
    except ValueError as problem:
        return Unreadable(str(problem))
    except OSError as problem:
        return Unreadable(f"cannot be read: {problem.strerror or problem}")
    return hashlib.blake2b(target.data, digest_size=DIGEST_BYTES).digest()


def estimated_total(done: int, share: float | None, limit: int | None) -> int:
    """How many samples there will be, judged by the share of the stream that ``done`` of them took."""
    total = done if not share else max(done, round(done / share))
    return total if limit is None else min(total, limit)
