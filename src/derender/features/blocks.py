"""A stream embedded in blocks of consecutive pictures, each by whoever is free, and put in order again.

A worker opens the stream itself, reads, decodes and computes the blocks it is given; only features, names,
labels and digests of pixels travel. Copies are dropped where the blocks meet, so rows and order are those of
one process; numbers are the same bit for bit as long as no picture was unreadable or a copy, and then to
rounding, because batches hold other pictures. Leaves out who starts the workers (ray_engine.py).
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np
import torch

from derender.data import (
    Decoded,
    Sample,
    SeenPixels,
    Skipped,
    Stream,
    Unreadable,
    decode_samples,
    quiet_pillow,
)
from derender.features.batches import Rows
from derender.features.extract import as_batch, evaluating, factor_codes

OpenStream = Callable[[], AbstractContextManager[Stream]]
"""Opens the stream anew, in whatever process."""

Computed = tuple[Rows, Mapping[str, np.ndarray], float | None]
"""Rows of a table, their features by factor, and how much of the stream lies behind (0..1), if known."""

Engine = Callable[[Stream, int, SeenPixels], AbstractContextManager[Iterator[Computed]]]
"""Given a stream, where to begin and the pixels seen before, gives the rest of the table in order."""


@dataclass(frozen=True)
class Block:
    """What a worker made of consecutive samples.

    Attributes:
        decoded: names, labels and digests; without pixels.
        codes: features by factor of those that could be read.
    """

    decoded: Decoded
    codes: Mapping[str, np.ndarray]


class BlockEmbedder:
    """Embeds blocks of a stream; best given blocks in ascending order, which it reads through once.

    Args:
        model: as for `embed_to_file`.
        open_stream: opens the stream.
        size: samples in a block.
        fit: what becomes of pictures that are not square.
        threads: torch's threads; None leaves them.
    """

    def __init__(
        self, model: Any, open_stream: OpenStream, size: int, fit: str = "crop", threads: int | None = None
    ):
        if threads is not None:
            torch.set_num_threads(threads)
        self.model, self.size, self.fit = model, size, fit
        self.opened = ExitStack()
        self.stream = self.opened.enter_context(open_stream())
        self.samples: Iterator[Sample] = iter(())
        self.at: int | None = None

    def close(self) -> None:
        """Release what the stream holds open."""
        self.opened.close()

    def embed(self, start: int) -> Block:
        """The block of samples from number ``start`` on."""
        if self.at is None or start < self.at:
            self.samples, self.at = self.stream.samples(start), start
        ahead = start - self.at
        limit = self.stream.limit
        size = self.size if limit is None else min(self.size, max(0, limit - start))
        samples = list(islice(self.samples, ahead, ahead + size))
        self.at = start + len(samples)
        with quiet_pillow(), evaluating(self.model):
            decoded = decode_samples(start, samples, self.model.image_size, self.fit)
            good = [row for row, found in enumerate(decoded.outcomes) if not isinstance(found, Unreadable)]
            codes = (
                factor_codes(self.model, as_batch(decoded.images[good], self.model.device)) if good else {}
            )
        return Block(replace(decoded, images=decoded.images[:0]), codes)


def in_order(
    blocks: Iterable[Block], seen: SeenPixels, *, keep_duplicates: bool = False
) -> Iterator[Computed]:
    """What blocks, given in the order of the stream, mean for the table; copies are dropped.

    Args:
        blocks: all of them from some place on.
        seen: pixels of the pictures before; grows.
        keep_duplicates: keep copies too.
    """
    for block in blocks:
        decoded = block.decoded
        outcomes = list(enumerate(decoded.outcomes))
        good = [row for row, found in outcomes if not isinstance(found, Unreadable)]
        digests = [found for _, found in outcomes if not isinstance(found, Unreadable)]
        positions = np.array([decoded.start + row for row in good], np.int64)
        first = seen.first(digests, positions.tolist()) == positions
        kept = np.flatnonzero(first | keep_duplicates)
        chosen = [good[row] for row in kept]
        rows = Rows(
            tuple(decoded.files[row] for row in chosen),
            positions[kept],
            tuple(digests[row] for row in kept),
            tuple(decoded.labels[row] for row in chosen),
            tuple(decoded.partitions[row] for row in chosen),
            decoded.start + len(decoded),
            tuple(
                Skipped(decoded.files[row], str(found))
                for row, found in outcomes
                if isinstance(found, Unreadable)
            ),
            int((~first).sum()),
        )
        codes = {name: codes[kept] for name, codes in block.codes.items()} if len(kept) else {}
        yield rows, codes, decoded.share
