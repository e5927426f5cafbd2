"""A stream in blocks of consecutive images: decoded, embedded, in order, no copies; here or on a cluster.

In this process a pool decodes ahead of the model. With Ray Data, blocks go to a pool of actors that each open
the stream themselves; only features, names, labels and digests of pixels travel. Copies are dropped where the
blocks meet, so rows, order and numbers are the same bit for bit either way.
"""

import logging
import pickle
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np
import torch
from jaxtyping import Int64

from derender.data import (
    Decoded,
    ImageSet,
    Sample,
    SeenPixels,
    Skipped,
    Stream,
    Unreadable,
    Value,
    ahead,
    decode_samples,
    decoded,
    quiet_pillow,
)
from derender.features.extract import as_batch, evaluating, factor_codes

OpenStream = Callable[[], AbstractContextManager[Stream]]
"""Opens the stream anew, in whatever process."""


@dataclass(frozen=True)
class TableRows:
    """The rows of a table that a block becomes, but for their features.

    Attributes:
        files: names.
        positions: the number of each in the stream or set.
        digests: 16 bytes of each one's pixels; b"" for a set.
        labels: of each, where the stream brings them.
        partitions: of each, where the stream brings them, or "".
        following: the number of the first sample after the block.
        skipped: unreadable ones among them.
        copies: how many identical copies are among them.
    """

    files: tuple[str, ...]
    positions: Int64[np.ndarray, " n"]
    digests: tuple[bytes, ...]
    labels: tuple[Mapping[str, Value], ...]
    partitions: tuple[str, ...]
    following: int
    skipped: tuple[Skipped, ...] = ()
    copies: int = 0


Computed = tuple[TableRows, Mapping[str, np.ndarray], float | None]
"""Rows of a table, their features by factor (none without rows), and the share of the stream read."""


@dataclass(frozen=True)
class Block:
    """Consecutive samples, computed.

    Attributes:
        decoded: names, labels and digests; without pixels.
        codes: features by factor of those that could be read.
    """

    decoded: Decoded
    codes: Mapping[str, np.ndarray]


def computed_block(model: Any, chunk: Decoded) -> Block:
    """The features of decoded samples; the model is in evaluation mode."""
    good = [row for row, outcome in enumerate(chunk.outcomes) if isinstance(outcome, bytes)]
    images = chunk.images if len(good) == len(chunk) else chunk.images[good]
    codes = factor_codes(model, as_batch(images, model.device)) if good else {}
    return Block(replace(chunk, images=chunk.images[:0]), codes)


@contextmanager
def local_blocks(
    model: Any,
    source: Stream | ImageSet,
    start: int,
    *,
    batch_size: int,
    fit: str = "crop",
    workers: int | None = None,
) -> Iterator[Iterator[Block]]:
    """The blocks from sample ``start`` on, computed in this process while a pool decodes ahead."""
    with quiet_pillow(), evaluating(model), ExitStack() as stack:
        if isinstance(source, ImageSet):
            chunks = _of_set(source, start, batch_size)
        else:
            pixels = decoded(source, model.image_size, fit=fit, start=start, workers=workers)
            chunks = stack.enter_context(ahead(_regrouped(pixels, batch_size), 2))
        yield (computed_block(model, chunk) for chunk in chunks)


def _of_set(images: ImageSet, start: int, size: int) -> Iterator[Decoded]:
    for first in range(start, len(images), size):
        files, pixels = images.files[first : first + size], np.array(images.images[first : first + size])
        n, share = len(files), (first + len(files)) / len(images)
        yield Decoded(first, files, pixels, (b"",) * n, ({},) * n, ("",) * n, share)


def _regrouped(chunks: Iterable[Decoded], size: int) -> Iterator[Decoded]:
    """The same samples, ``size`` at a time."""
    waiting: list[Decoded] = []
    for chunk in chunks:
        waiting.append(chunk)
        while sum(map(len, waiting)) >= size:
            whole = _joined(waiting)
            yield _part(whole, 0, size)
            waiting = [_part(whole, size, len(whole))] if len(whole) > size else []
    if waiting:
        yield _joined(waiting)


def _joined(chunks: list[Decoded]) -> Decoded:
    if len(chunks) == 1:
        return chunks[0]
    joined = {
        name: sum((getattr(chunk, name) for chunk in chunks), ())
        for name in ("files", "outcomes", "labels", "partitions")
    }
    images = np.concatenate([chunk.images for chunk in chunks])
    return replace(chunks[-1], start=chunks[0].start, images=images, **joined)


def _part(chunk: Decoded, first: int, last: int) -> Decoded:
    cut = {
        name: getattr(chunk, name)[first:last]
        for name in ("files", "images", "outcomes", "labels", "partitions")
    }
    return replace(chunk, start=chunk.start + first, **cut)


def in_order(blocks: Iterable[Block], seen: SeenPixels, keep_duplicates: bool = False) -> Iterator[Computed]:
    """Blocks in the order of the stream as rows of the table; copies are dropped, unless they are kept.

    ``seen`` holds the pixels of the images before, and grows.
    """
    for block in blocks:
        chunk = block.decoded
        good = [row for row, outcome in enumerate(chunk.outcomes) if isinstance(outcome, bytes)]
        digests = [outcome for outcome in chunk.outcomes if isinstance(outcome, bytes)]
        positions = np.array([chunk.start + row for row in good], np.int64)
        first = np.ones(len(good), bool)
        if digests and digests[0]:  # copies are dropped from a set when it is read
            first = seen.first(digests, positions.tolist()) == positions
        kept = np.flatnonzero(first | keep_duplicates)
        chosen = [good[row] for row in kept]
        skipped = [
            Skipped(chunk.files[row], str(outcome))
            for row, outcome in enumerate(chunk.outcomes)
            if isinstance(outcome, Unreadable)
        ]
        rows = TableRows(
            tuple(chunk.files[row] for row in chosen),
            positions[kept],
            tuple(digests[row] for row in kept),
            tuple(chunk.labels[row] for row in chosen),
            tuple(chunk.partitions[row] for row in chosen),
            chunk.start + len(chunk),
            tuple(skipped),
            int((~first).sum()),
        )
        codes = {name: values[kept] for name, values in block.codes.items()} if len(kept) else {}
        yield rows, codes, chunk.share


class BlockEmbedder:
    """Embeds blocks of a stream; best called with blocks in ascending order, which it reads through once.

    Args:
        model: as for `embed_to_file`.
        open_stream: opens the stream.
        size: samples in a block.
        fit: how images that are not square are read.
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
        """Release the open stream."""
        self.opened.close()

    def embed(self, start: int) -> Block:
        """The block of samples from number ``start`` on."""
        if self.at is None or start < self.at:
            self.samples, self.at = self.stream.samples(start), start
        passed, limit = start - self.at, self.stream.limit
        size = self.size if limit is None else min(self.size, max(0, limit - start))
        samples = list(islice(self.samples, passed, passed + size))
        self.at = start + len(samples)
        with quiet_pillow(), evaluating(self.model):
            return computed_block(self.model, decode_samples(start, samples, self.model.image_size, self.fit))


@contextmanager
def ray_blocks(
    model: Any,
    stream: Stream,
    start: int,
    *,
    open_stream: OpenStream,
    batch_size: int,
    fit: str = "crop",
    workers: int = 2,
) -> Iterator[Iterator[Block]]:
    """As ``local_blocks``, with ``workers`` actors of one core each, or of one GPU each for a model on one.

    Ray starts an actor anew when its process or machine dies, and gives its block to another. Every machine
    must be able to open the data under the same name. Without a cluster (``ray start``, RAY_ADDRESS) the
    actors are processes on this machine. The stream's samples are counted first.

    Raises:
        ValueError: Ray is not installed.
    """
    try:
        import ray  # pyright: ignore[reportMissingImports]
        import ray.data  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ValueError(
            "engine 'ray' needs Ray: pip install 'derender[ray]', or use engine 'local'"
        ) from error
    left = None if stream.limit is None else max(0, stream.limit - start)
    numbers = -(-sum(1 for _ in islice(stream.samples(start), left)) // batch_size)

    def blocks() -> Iterator[Block]:
        if not numbers:
            return
        turns = [{"number": number} for number in range(numbers)]
        made = ray.data.from_items(turns, override_num_blocks=numbers).map_batches(
            _Actor,
            fn_constructor_args=(model, open_stream, batch_size, fit, start),
            batch_size=1,
            compute=ray.data.ActorPoolStrategy(size=workers),
            num_cpus=1,
            num_gpus=int(model.device.type != "cpu"),
        )
        for row in made.iter_rows():
            yield pickle.loads(row["block"])

    started = not ray.is_initialized()
    if started:
        ray.init(logging_level=logging.ERROR, log_to_driver=False, include_dashboard=False)
    context = ray.data.DataContext.get_current()
    before = context.execution_options.preserve_order, context.enable_progress_bars
    context.execution_options.preserve_order, context.enable_progress_bars = True, False
    try:
        yield blocks()
    finally:
        context.execution_options.preserve_order, context.enable_progress_bars = before
        if started:
            ray.shutdown()


class _Actor:
    """A `BlockEmbedder` as Ray Data calls it: block numbers in, pickled blocks out."""

    def __init__(self, model: Any, open_stream: OpenStream, size: int, fit: str, start: int):
        self.embedder = BlockEmbedder(model, open_stream, size, fit, threads=1)
        self.size, self.start = size, start

    def __call__(self, numbers: dict[str, Any]) -> dict[str, list[bytes]]:
        blocks = [self.embedder.embed(self.start + self.size * int(number)) for number in numbers["number"]]
        return {"block": [pickle.dumps(block) for block in blocks]}
