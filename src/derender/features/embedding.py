"""From a model and any source to a feature table on disk, which is never whole in memory.

Reading and decoding, computing, and writing overlap; what waits between them is bounded. Parts lie beside the
table in a folder of its name with ``.partial`` until all are there: a run that was stopped goes on from them,
and gives the same table, bit for bit, because batches hold the same pictures.
"""

import hashlib
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import PIL
import torch

from derender.data import (
    READER_VERSION,
    PictureSet,
    Skipped,
    Stream,
    ahead,
    decoded,
    estimated_total,
    quiet_pillow,
    sample_checksum,
)
from derender.features.batches import Batch, Rows, batches_of_chunks, batches_of_set
from derender.features.blocks import Computed, Engine
from derender.features.extract import (
    Progress,
    as_batch,
    check_size,
    evaluating,
    factor_codes,
    model_facts,
    table_labels,
)
from derender.features.parquet import Columns, write_row_groups
from derender.features.parts import Parts
from derender.features.table import check_finite, check_names

PART_ROWS = 4096
"""A part is written when this many rows are there."""


@dataclass(frozen=True)
class Embedded:
    """What was written.

    Attributes:
        path: the table.
        rows: pictures in it.
        factors: numbers of each factor.
        labels: names of label columns.
        origin: as in the table.
        skipped: how many pictures could not be read.
        examples: the first of those, with reasons.
        copies: how many were identical copies of an earlier one.
        resumed: how many rows an earlier run had made.
    """

    path: Path
    rows: int
    factors: dict[str, int]
    labels: tuple[str, ...]
    origin: dict[str, Any]
    skipped: int
    examples: tuple[Skipped, ...]
    copies: int
    resumed: int


def embed_to_file(
    model: Any,
    source: Stream | PictureSet,
    path: str | Path,
    *,
    fit: str = "crop",
    keep_duplicates: bool = False,
    batch_size: int = 256,
    fresh: bool = False,
    workers: int | None = None,
    progress: Progress | None = None,
    origin: Mapping[str, Any] | None = None,
    engine: Engine | None = None,
) -> Embedded:
    """Run a model's encoders over a stream or set and write the table, going on where an earlier run stopped.

    Args:
        model: a module with ``embed(pictures in 0..1) -> {factor: (N, D)}``, ``device`` and ``image_size``.
        source: a stream, or a set that was read at the model's image size.
        path: the parquet file; parts lie in ``PATH.partial`` meanwhile.
        fit: what becomes of pictures that are not square (of a stream).
        keep_duplicates: keep identical copies (of a stream).
        batch_size: pictures at a time.
        fresh: begin anew where an earlier run made something else; otherwise that is an error.
        workers: decoding threads; by default one for each core.
        progress: called with (pictures done, estimated total) after every batch.
        origin: further facts for the table.
        engine: who reads and computes a stream, if not this process (ray_engine.py).

    Raises:
        ValueError: no picture can be read, a feature is not finite, or the parts are of another run.
        KeyboardInterrupt: it was stopped; the message says what is kept.
    """
    path = Path(path)
    if batch_size < 1:
        raise ValueError(f"batch_size must be 1 or more, got {batch_size}")
    facts = {**model_facts(model, source.source, source.layout), **(origin or {})}
    if isinstance(source, PictureSet):
        check_size(model, source)
        labels = {name: column.tolist() for name, column in source.labels.items()}
        content: object = (source.files, labels, sample_checksum(source.images))
        limit = None
    else:
        content = (source.place, source.identity(), fit, source.limit, keep_duplicates, READER_VERSION)
        limit = source.limit
    plan = {
        "origin": facts,
        "pictures": hashlib.sha256(repr((PIL.__version__, content)).encode("utf-8", "replace")).hexdigest(),
        "image_size": model.image_size,
        "batch_size": batch_size,
        "device": str(model.device),
        "torch": torch.__version__,
    }
    parts = Parts(path.with_name(f"{path.name}.partial"), plan, fresh=fresh)
    resumed = parts.so_far.rows

    @contextmanager
    def here() -> Iterator[Iterator[Computed]]:
        start = parts.so_far.following
        if isinstance(source, PictureSet):
            chunks = nullcontext(batches_of_set(source, batch_size, start))
        else:
            pixels = decoded(source, model.image_size, fit=fit, start=start, workers=workers)
            copies = {"keep_duplicates": keep_duplicates}
            chunks = ahead(batches_of_chunks(pixels, batch_size, parts.seen(), **copies), 2)
        with quiet_pillow(), evaluating(model), chunks as batches:
            yield (_computed(model, batch) for batch in batches)

    def elsewhere() -> AbstractContextManager[Iterator[Computed]]:
        assert engine is not None
        if isinstance(source, PictureSet):
            raise ValueError("one part of a split is embedded in this process: leave the engine out")
        return engine(source, parts.so_far.following, parts.seen())

    try:
        with here() if engine is None else elsewhere() as computed, _writing(parts) as add:
            for rows, codes, share in computed:
                check_finite(codes, rows.files)
                add(rows, codes)
                if progress is not None:
                    progress(rows.following, estimated_total(rows.following, share, limit))
    except Exception:
        parts.remove_if_empty()
        raise
    except KeyboardInterrupt as stopped:
        if parts.remove_if_empty():
            raise
        raise KeyboardInterrupt(
            f"stopped by Ctrl-C; {parts.so_far.rows:,} rows are kept in {parts.folder}: "
            "the same command goes on from there"
        ) from stopped
    if progress is not None:
        progress(parts.so_far.following, parts.so_far.following)
    return _finish(parts, path, source, facts, resumed)


def _computed(model: Any, batch: Batch) -> Computed:
    if batch.images is None:
        return batch.rows, {}, batch.share
    return batch.rows, factor_codes(model, as_batch(batch.images, model.device)), batch.share


@contextmanager
def _writing(parts: Parts) -> Iterator[Callable[[Rows, Mapping[str, np.ndarray]], None]]:
    """Take the rows of batches and write them as parts in a thread of its own, one part at a time.

    Ctrl-C writes what is waiting; any other error drops it.
    """
    waiting: list[tuple[Rows, Mapping[str, np.ndarray]]] = []
    written: list[Future[None]] = []

    def write() -> None:
        for future in written:
            future.result()
        written.clear()
        rows = [rows for rows, _ in waiting]
        codes = [codes for _, codes in waiting if codes]
        waiting.clear()
        written.append(pool.submit(parts.write, rows, codes))

    def add(rows: Rows, codes: Mapping[str, np.ndarray]) -> None:
        waiting.append((rows, codes))
        if sum(len(one.files) for one, _ in waiting) >= PART_ROWS:
            write()

    with ThreadPoolExecutor(1, thread_name_prefix="write") as pool:
        try:
            yield add
        except KeyboardInterrupt:
            if waiting:
                write()
            raise
        if waiting:
            write()
        for future in written:
            future.result()


def _finish(
    parts: Parts, path: Path, source: Stream | PictureSet, facts: dict[str, Any], resumed: int
) -> Embedded:
    """Put the parts together, then delete them."""
    so_far = parts.so_far
    if not so_far.rows:
        parts.remove()
        first = (
            f"; the first is {so_far.examples[0].file!r}: {so_far.examples[0].reason}"
            if so_far.skipped
            else ""
        )
        raise ValueError(f"no picture in {source.source} ({source.layout}) can be read{first}")
    factors: dict[str, int] = {}
    labels: list[str] = []
    known = _known_labels(source)

    def groups() -> Iterator[Columns]:
        for columns in parts.columns(facts, known):
            factors.update({name: values.shape[1] for name, values in columns.factors.items()})
            labels[:] = columns.labels
            check_names(columns.factors, columns.labels)
            yield columns

    rows = write_row_groups(path, groups())
    parts.remove()
    passed_over = () if isinstance(source, PictureSet) else source.passed_over
    return Embedded(
        path,
        rows,
        factors,
        tuple(labels),
        facts,
        so_far.skipped + len(passed_over),
        (*passed_over, *so_far.examples),
        so_far.copies,
        resumed,
    )


def _known_labels(source: Stream | PictureSet) -> Callable[[np.ndarray], dict[str, np.ndarray]] | None:
    """Labels by position where they are known without reading pictures."""
    if isinstance(source, PictureSet):
        columns = table_labels(source)
    elif source.table is not None:
        owners = {} if source.table.partition is None else {"partition": source.table.partition}
        columns = {**owners, **source.table.labels}
    else:
        return None
    return lambda positions: {name: column[positions] for name, column in columns.items()}
