"""Embedding on many machines through Ray Data: blocks of the stream go to a pool of actors, in order back.

Ray starts an actor anew when its process or machine dies, and gives its block to another. Every machine must
be able to open the data under the same name (a shared folder, a Hugging Face id). Without a cluster
(``ray start``, RAY_ADDRESS) the actors are processes on this machine. Leaves out what a block is (blocks.py).
"""

import logging
import pickle
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from typing import Any

from derender.data import SeenPixels, Stream
from derender.features.blocks import Block, BlockEmbedder, Computed, Engine, OpenStream, in_order


def ray_engine(
    model: Any,
    open_stream: OpenStream,
    *,
    workers: int = 2,
    batch_size: int = 256,
    fit: str = "crop",
    keep_duplicates: bool = False,
) -> Engine:
    """Embed with ``workers`` actors of one core each (of one GPU each where the model is on one).

    The stream's samples are counted first; shards are read through for that.

    Raises:
        ValueError: Ray is not installed.
    """
    try:
        import ray  # pyright: ignore[reportMissingImports]
        import ray.data  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ValueError(
            "--engine ray needs Ray: pip install 'derender[ray]', or leave --engine out"
        ) from error

    @contextmanager
    def computed(stream: Stream, start: int, seen: SeenPixels) -> Iterator[Iterator[Computed]]:
        samples = islice(
            stream.samples(start), None if stream.limit is None else max(0, stream.limit - start)
        )
        count = sum(1 for _ in samples)
        started = not ray.is_initialized()
        if started:
            ray.init(logging_level=logging.ERROR, log_to_driver=False, include_dashboard=False)
        context = ray.data.DataContext.get_current()
        before = context.execution_options.preserve_order, context.enable_progress_bars
        context.execution_options.preserve_order, context.enable_progress_bars = True, False
        try:
            yield in_order(blocks(start, count), seen, keep_duplicates=keep_duplicates)
        finally:
            context.execution_options.preserve_order, context.enable_progress_bars = before
            if started:
                ray.shutdown()

    def blocks(start: int, count: int) -> Iterator[Block]:
        if not count:
            return
        on_gpu = model.device.type != "cpu"
        numbers = -(-count // batch_size)
        turns = [{"number": number} for number in range(numbers)]
        made = ray.data.from_items(turns, override_num_blocks=numbers).map_batches(
            _Actor,
            fn_constructor_args=(model, open_stream, batch_size, fit, start),
            batch_size=1,
            compute=ray.data.ActorPoolStrategy(size=workers),
            num_cpus=1,
            num_gpus=int(on_gpu),
        )
        for row in made.iter_rows():
            yield pickle.loads(row["block"])

    return computed


class _Actor:
    """A `BlockEmbedder` as Ray Data calls it: block numbers in, pickled blocks out."""

    def __init__(self, model: Any, open_stream: OpenStream, size: int, fit: str, start: int):
        self.embedder = BlockEmbedder(model, open_stream, size, fit, threads=1)
        self.size, self.start = size, start

    def __call__(self, numbers: dict[str, Any]) -> dict[str, list[bytes]]:
        found = [self.embedder.embed(self.start + self.size * int(number)) for number in numbers["number"]]
        return {"block": [pickle.dumps(block) for block in found]}
