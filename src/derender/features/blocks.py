"""A stream in blocks of consecutive images: decoded and embedded, in order; here or on a cluster.

In this process a pool decodes ahead of the model. With Ray Data, blocks go to a pool of actors that each open
the stream themselves; only features, names, labels and digests of pixels travel. Rows, order and numbers are
the same bit for bit either way.
"""

import logging
import pickle
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
import torch

from derender.data import Decoded, ImageSet, Sample, Stream, decode_samples, decoded, quiet_pillow
from derender.features.extract import as_batch, evaluating, factor_codes

OpenStream = Callable[[], AbstractContextManager[Stream]]
"""Opens the stream anew, in whatever process."""
Block = tuple[Decoded, Mapping[str, np.ndarray]]
"""Consecutive samples without their pixels, and the features by factor of those that could be read."""


def embedded_block(model: Any, chunk: Decoded) -> Block:
    """The features of decoded samples; the model is in evaluation mode."""
    good = [row for row, outcome in enumerate(chunk.outcomes) if isinstance(outcome, bytes)]
    codes = factor_codes(model, as_batch(chunk.images[good], model.device)) if good else {}
    return replace(chunk, images=chunk.images[:0]), codes


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
            chunks = _regrouped(stack.enter_context(closing(pixels)), batch_size)
        yield (embedded_block(model, chunk) for chunk in chunks)


def _of_set(images: ImageSet, start: int, size: int) -> Iterator[Decoded]:
    for first in range(start, len(images), size):
        files, pixels = images.files[first : first + size], np.array(images.images[first : first + size])
        n, share = len(files), (first + len(files)) / len(images)
        yield Decoded(first, files, pixels, (b"",) * n, ({},) * n, ("",) * n, share)


def _regrouped(chunks: Iterable[Decoded], size: int) -> Iterator[Decoded]:
    """The same samples, ``size`` at a time."""
    rows = (
        (chunk.start + row, one[0], one[1], one[2], one[3], one[4], chunk.share)
        for chunk in chunks
        for row, one in enumerate(
            zip(chunk.files, chunk.images, chunk.outcomes, chunk.labels, chunk.partitions, strict=True)
        )
    )
    while group := list(islice(rows, size)):
        numbers, files, images, outcomes, labels, partitions, shares = zip(*group, strict=True)
        yield Decoded(numbers[0], files, np.stack(images), outcomes, labels, partitions, shares[-1])


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

    def embed(self, start: int) -> Block:
        """The block of samples from number ``start`` on."""
        if self.at is None or start < self.at:
            self.samples, self.at = self.stream.samples(start), start
        passed, limit = start - self.at, self.stream.limit
        size = self.size if limit is None else min(self.size, max(0, limit - start))
        samples = list(islice(self.samples, passed, passed + size))
        self.at = start + len(samples)
        with quiet_pillow(), evaluating(self.model):
            return embedded_block(self.model, decode_samples(start, samples, self.model.image_size, self.fit))

    def __call__(self, numbers: dict[str, Any]) -> dict[str, list[bytes]]:
        """As Ray Data calls it: the first samples of blocks in, pickled blocks out."""
        return {"block": [pickle.dumps(self.embed(int(start))) for start in numbers["start"]]}


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
    end = start + sum(1 for _ in islice(stream.samples(start), left))
    starts = [{"start": first} for first in range(start, end, batch_size)]

    def blocks() -> Iterator[Block]:
        made = ray.data.from_items(starts, override_num_blocks=len(starts)).map_batches(
            BlockEmbedder,
            fn_constructor_args=(model, open_stream, batch_size, fit, 1),
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
        yield blocks() if starts else iter(())
    finally:
        context.execution_options.preserve_order, context.enable_progress_bars = before
        if started:
            ray.shutdown()
