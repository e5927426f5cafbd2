"""A whole stream, decoded once and in order into the memory-mapped file, so that training has random access.

Memory holds what is on the way, and of every picture its name, its labels and 24 bytes of digest.
"""

import hashlib
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import PIL
from jaxtyping import UInt8

from derender.data.cache import Cached, GrowingCache, cache_file, growing_cache, read_cache
from derender.data.decode import READER_VERSION, Unreadable, quiet_pillow
from derender.data.duplicates import Duplicate
from derender.data.layout import Labels, text_column
from derender.data.loading import Loaded, Progress
from derender.data.source import Skipped
from derender.data.stream.decoding import Decoded, ahead, decoded
from derender.data.stream.labels import Kinds, column_of
from derender.data.stream.sample import Stream, Value
from derender.data.stream.seen import SeenPixels


@dataclass(frozen=True)
class Collected:
    """A stream that has been read.

    Attributes:
        images: the pictures, in a memory map.
        loaded: their names, and what became of the others.
        labels: columns by name.
        partition: the owners' own split, or None.
    """

    images: UInt8[np.ndarray, "n 3 s s"]
    loaded: Loaded
    labels: Labels
    partition: np.ndarray | None


def collect(
    stream: Stream,
    image_size: int,
    folder: Path,
    *,
    fit: str = "crop",
    keep_duplicates: bool = False,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Collected:
    """Read a stream through the cache in ``folder``; what is there already and still fits is not read again.

    Args:
        stream: where the pictures come from.
        image_size: side of the square pictures, in pixels.
        folder: where the memory-mapped file lies or is made.
        fit: what becomes of pictures that are not square.
        keep_duplicates: keep all of identical pictures and not only the first.
        workers: threads; by default one for each core.
        progress: called with (done, total); the total is an estimate from the share that has been read.
    """
    settings = (READER_VERSION, stream.layout, image_size, fit, keep_duplicates, stream.limit)
    mark = hashlib.sha256(repr((settings, PIL.__version__, stream.identity())).encode()).hexdigest()
    name = re.sub(r"[^\w.-]+", "-", stream.source.rpartition("/")[2])
    file = cache_file(folder, name, (stream.place, settings))
    cached = read_cache(file, mark, image_size)
    if cached is None:
        with growing_cache(file, image_size) as writer:
            growth = _Growth(writer, keep_duplicates)
            chunks = decoded(stream, image_size, fit=fit, workers=workers)
            with quiet_pillow(), ahead(chunks) as ready:
                for chunk in ready:
                    growth.add(chunk)
                    if progress is not None:
                        done = chunk.start + len(chunk)
                        progress(done, estimated_total(done, chunk.share, stream.limit))
            growth.finish(stream, mark)
        cached = read_cache(file, mark, image_size)
        if cached is None:
            raise OSError(f"decoded pictures could not be read back from {file}; check the disk")
    if progress is not None:
        progress(len(cached.images), len(cached.images))
    return _collected(cached)


def estimated_total(done: int, share: float | None, limit: int | None) -> int:
    """How many samples there will be, judged by the share of the stream that ``done`` of them took."""
    total = done if not share else max(done, round(done / share))
    return total if limit is None else min(total, limit)


@dataclass
class _Growth:
    """What is known after each chunk."""

    writer: GrowingCache
    keep_duplicates: bool
    files: list[str] = field(default_factory=list)
    skipped: list[Skipped] = field(default_factory=list)
    copies: list[tuple[str, int]] = field(default_factory=list)
    columns: dict[str, list[Value]] = field(default_factory=dict)
    partitions: list[str] = field(default_factory=list)
    kinds: Kinds = field(default_factory=Kinds)
    seen: SeenPixels = field(default_factory=SeenPixels)
    names: list[str] = field(default_factory=list)

    def add(self, chunk: Decoded) -> None:
        """Write the chunk's good pictures and note the others."""
        readable = [row for row, outcome in enumerate(chunk.outcomes) if isinstance(outcome, bytes)]
        numbers = range(len(self.names), len(self.names) + len(readable))
        digests = [outcome for outcome in chunk.outcomes if isinstance(outcome, bytes)]
        first = self.seen.first(digests, numbers)
        kept = []
        for row, number, earlier in zip(readable, numbers, first.tolist(), strict=True):
            if earlier != number:
                self.copies.append((chunk.files[row], earlier))
            self.names.append(chunk.files[row])
            if earlier == number or self.keep_duplicates:
                kept.append(row)
        self.writer.append(chunk.images[kept])
        for row in kept:
            labels = chunk.labels[row]
            self.kinds.see(labels)
            for name in labels:
                self.columns.setdefault(name, [None] * len(self.files))
            for name, column in self.columns.items():
                column.append(labels.get(name))
            self.files.append(chunk.files[row])
            self.partitions.append(chunk.partitions[row])
        self.skipped += [
            Skipped(file, str(outcome))
            for file, outcome in zip(chunk.files, chunk.outcomes, strict=True)
            if isinstance(outcome, Unreadable)
        ]

    def finish(self, stream: Stream, mark: str) -> None:
        """Seal the file; a stream without a single picture is an error."""
        if not self.files:
            raise nothing_readable(stream, self.skipped[0] if self.skipped else None)
        duplicates = tuple(Duplicate(file, self.names[first]) for file, first in self.copies)
        further = {
            "labels": {name: [self.kinds[name], column] for name, column in self.columns.items()},
            "partition": self.partitions if any(self.partitions) else None,
        }
        loaded = Loaded(tuple(self.files), tuple(self.skipped), duplicates)
        self.writer.finish(loaded, mark, further)


def nothing_readable(stream: Stream, first: Skipped | None) -> ValueError:
    """The error for a stream without a usable picture."""
    why = "it is empty" if first is None else f"the first is {first.file!r}: {first.reason}"
    return ValueError(f"no picture in {stream.source} ({stream.layout}) can be read; {why}")


def _collected(cached: Cached) -> Collected:
    labels = {
        name: column_of(name, ({name: value} for value in values), kind)
        for name, (kind, values) in cached.further["labels"].items()
    }
    partition = cached.further["partition"]
    return Collected(
        cached.images, cached.loaded, labels, None if partition is None else text_column(partition)
    )
