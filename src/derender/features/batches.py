"""Batches of pictures for embedding, from a stream or from a set that is in memory or mapped into it.

Of a stream every picture is decoded once and kept only while its batch is computed. Identical copies are
dropped as when a set is read, so batch for batch the pictures are the same either way.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Int64, UInt8

from derender.data import Decoded, PictureSet, SeenPixels, Skipped, Unreadable, Value


@dataclass(frozen=True)
class Rows:
    """What a table has to know of a batch besides its features.

    Attributes:
        files: names.
        positions: the number of each in the stream or set.
        digests: 16 bytes of each one's pixels; b"" where nobody asked.
        labels: of each, where the stream brings them.
        partitions: of each, where the stream brings them, or "".
        following: the number after the last one: where to go on.
        skipped: unreadable ones before ``following`` and after the batch before.
        copies: how many identical copies lie there.
    """

    files: tuple[str, ...]
    positions: Int64[np.ndarray, " n"]
    digests: tuple[bytes, ...]
    labels: tuple[Mapping[str, Value], ...]
    partitions: tuple[str, ...]
    following: int
    skipped: tuple[Skipped, ...] = ()
    copies: int = 0


@dataclass(frozen=True)
class Batch:
    """Some pictures on their way through a model.

    Attributes:
        images: (n, 3, S, S) RGB; None where only unreadable pictures and copies were left.
        rows: which they are.
        share: how much of all has been read, 0..1; None where nobody knows.
    """

    images: UInt8[np.ndarray, "n 3 s s"] | None
    rows: Rows
    share: float | None


def batches_of_set(pictures: PictureSet, batch_size: int, start: int = 0) -> Iterator[Batch]:
    """The pictures of a set in its order, from number ``start`` on."""
    for first in range(start, len(pictures), batch_size):
        rows = np.arange(first, min(first + batch_size, len(pictures)))
        count = len(rows)
        files = pictures.files[first : first + count]
        yield Batch(
            np.array(pictures.images[first : first + count]),
            Rows(files, rows, (b"",) * count, ({},) * count, ("",) * count, first + count),
            (first + count) / len(pictures),
        )


def batches_of_chunks(
    chunks: Iterable[Decoded], batch_size: int, seen: SeenPixels, *, keep_duplicates: bool = False
) -> Iterator[Batch]:
    """Batches of exactly ``batch_size`` good pictures (the last one has the rest, perhaps none).

    Args:
        chunks: a decoded stream.
        batch_size: pictures in a batch.
        seen: pixels of the pictures before; grows.
        keep_duplicates: keep copies too.
    """
    waiting = _Waiting()
    for chunk in chunks:
        waiting.add(chunk, seen, keep_duplicates)
        while len(waiting.entries) >= batch_size:
            yield waiting.cut(batch_size)
    if waiting.entries or waiting.skipped or waiting.copies:
        yield waiting.cut(None)


@dataclass(frozen=True)
class _Entry:
    position: int
    chunk: Decoded
    row: int


@dataclass
class _Waiting:
    """Good pictures that no batch has yet, and the positions of others."""

    entries: list[_Entry] = field(default_factory=list)
    skipped: list[tuple[int, Skipped]] = field(default_factory=list)
    copies: list[int] = field(default_factory=list)
    following: int = 0

    def add(self, chunk: Decoded, seen: SeenPixels, keep_duplicates: bool) -> None:
        good = [row for row, outcome in enumerate(chunk.outcomes) if not isinstance(outcome, Unreadable)]
        digests = [outcome for outcome in chunk.outcomes if not isinstance(outcome, Unreadable)]
        positions = [chunk.start + row for row in good]
        first = seen.first(digests, positions)
        for row, position, earlier in zip(good, positions, first.tolist(), strict=True):
            if earlier != position:
                self.copies.append(position)
            if earlier == position or keep_duplicates:
                self.entries.append(_Entry(position, chunk, row))
        self.skipped += [
            (chunk.start + row, Skipped(chunk.files[row], str(outcome)))
            for row, outcome in enumerate(chunk.outcomes)
            if isinstance(outcome, Unreadable)
        ]
        self.following = chunk.start + len(chunk)

    def cut(self, count: int | None) -> Batch:
        """The first ``count`` pictures with what lies between them; None: all that is left."""
        chosen = self.entries[:count]
        self.entries = self.entries[len(chosen) :]
        following = self.following if count is None else chosen[-1].position + 1
        skipped = tuple(row for position, row in self.skipped if position < following)
        copies = sum(position < following for position in self.copies)
        self.skipped, self.copies = self.skipped[len(skipped) :], self.copies[copies:]
        images = [entry.chunk.images[entry.row] for entry in chosen]
        digests = [entry.chunk.outcomes[entry.row] for entry in chosen]
        rows = Rows(
            tuple(entry.chunk.files[entry.row] for entry in chosen),
            np.array([entry.position for entry in chosen], np.int64),
            tuple(digest for digest in digests if not isinstance(digest, Unreadable)),
            tuple(entry.chunk.labels[entry.row] for entry in chosen),
            tuple(entry.chunk.partitions[entry.row] for entry in chosen),
            following,
            skipped,
            copies,
        )
        return Batch(np.stack(images) if images else None, rows, chosen[-1].chunk.share if chosen else 1.0)
