"""From a model and any images to a feature table: in memory, or on disk and never whole in memory.

On the way to a file parts are written beside it, in a folder of its name with ``.partial``, until all are
there. A stopped run continues from them with the same batches, and gives the same table, bit for bit.
"""

import hashlib
import shutil
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, Literal

import PIL
import torch

from derender.data import ImageSet, Skipped, Stream, estimated_total, open_images
from derender.data.cache import sample_checksum
from derender.data.image import READER_VERSION
from derender.features.blocks import PARTS_FORMAT, Parts, Rows, local_blocks, ray_blocks, rows_of
from derender.features.extract import check_size, embed_image_set, model_facts, table_labels
from derender.features.parquet import refuse_folder, write_tables
from derender.features.table import FeatureTable
from derender.inputs import Progress, as_images, as_model
from derender.storage.places import counted, model_folder, require_known
from derender.training.held_out_errors import read_errors, reconstruction_percentile, unlike
from derender.training.process import locked

PART_ROWS = 4096  # a part is written when this many rows are there
LISTED_SKIPPED = 20  # so many unreadable images are named; all are counted
LOOKED_AT = 60  # images that tell whether a model suits them
ENGINES = ("local", "ray")
Source = Stream | ImageSet
Facts = dict[str, Any]


@dataclass(frozen=True)
class Embedded:
    """A feature table that was written: its rows, sizes of the factors, names of the labels, and origin.

    ``skipped`` images could not be read (``examples`` has the first), ``copies`` were identical to an earlier
    one, ``resumed`` rows were made by an earlier run. ``kept``: the copies are in the table.
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
    source: str
    layout: str
    kept: bool = False

    def describe(self) -> str:
        """One line: how many images of which data set, how many were left out or had been there."""
        copies = f"identical copies {'kept' if self.kept else 'dropped'}"
        counts = {"of them from the run before": self.resumed, "skipped": self.skipped, copies: self.copies}
        further = [f"{count:,} {text}" for text, count in counts.items() if count]
        return ", ".join([f"{counted(self.rows, 'images')} from {self.source} ({self.layout})", *further])


def embed(
    images: ImageSet | str | Path, model: Any = "faces-64", *, dataset: str = "auto", part: str = "all",
    limit: int | None = None, batch_size: int = 256, fit_steps: int | None = None, device: str = "auto",
    progress: Progress | None = None,
) -> FeatureTable:  # fmt: skip
    """The features of images as a table in memory: one row an image, one feature per factor, and the labels.

    Args:
        images: an image set, or a folder, zip, shards or Hugging Face id.
        model: a trained model or its name (a run folder, a saved folder, a bundled name, a Hub id), or a
            network that `derender.baselines.open_baseline` opened.
        dataset, part, limit: how the images are read, see `derender.inputs.as_images`.
        batch_size: images at a time; changes speed and memory only.
        fit_steps: steps of test-time optimisation for its features; None keeps the model's own.
        device: "auto", "cpu" or "cuda".
        progress: called with (images done, images in all).
    """
    net, origin = _network(model, device, fit_steps)
    how = {"dataset": dataset, "limit": limit, "part": part, "model": origin.get("source")}
    read = as_images(images, net.image_size, **how)
    origin |= {} if part == "all" else {"part": part}
    return embed_image_set(net, read, batch_size=batch_size, progress=progress, origin=origin)


def embed_to_file(
    images: Stream | ImageSet | str | Path, model: Any, out: str | Path, *, dataset: str = "auto",
    part: str = "all", limit: int | None = None, fit: str = "crop", keep_duplicates: bool = False,
    batch_size: int = 256, fit_steps: int | None = None, device: str = "auto",
    engine: Literal["local", "ray"] | str = "local", workers: int | None = None, fresh: bool = False,
    origin: Mapping[str, Any] | None = None, progress: Progress | None = None,
) -> Embedded:  # fmt: skip
    """Write the feature table of any number of images, going on where an earlier run stopped.

    Args:
        images: as for ``embed``, or an open stream.
        out: the parquet file; parts are in ``OUT.partial`` meanwhile.
        fit, keep_duplicates: how images of a stream that are not square are read; keep identical copies.
        model, dataset, part, limit, batch_size, fit_steps, device: as for ``embed``.
        engine: "local", or "ray": on the machines of a Ray cluster, which open ``images`` by their address.
        workers: decoding threads (default: one for each core); actors of Ray (default: 2).
        fresh: begin anew where an earlier run made something else; otherwise that is an error.
        origin: further facts for the table.
        progress: called with (images done, estimated total) after every batch.

    Raises:
        ValueError: no image can be read, a feature is not finite, or parts are another run's or in writing.
        KeyboardInterrupt: it was stopped; the message says what is kept.
    """
    path = Path(out)
    if path.suffix.lower() not in ("", ".parquet"):
        raise ValueError(f"{out}: a feature table is a parquet file, name it so (pandas reads it)")
    refuse_folder(path)
    if batch_size < 1:
        raise ValueError(f"batch_size must be 1 or more, got {batch_size}")
    require_known("engine", engine, ENGINES)
    if engine == "ray" and (part != "all" or not isinstance(images, str | Path)):
        raise ValueError("engine 'ray' embeds all images of an address: use part 'all', and name a data set")
    net, made_by = _network(model, device, fit_steps)
    with ExitStack() as stack:
        address, reopen = images, None
        if isinstance(address, str | Path):
            reopen = partial(open_images, str(address), dataset=dataset, limit=limit)
            if part == "all":
                images = stack.enter_context(reopen())
            else:
                split = {**made_by, **(origin or {})}.get("source")
                how = {"dataset": dataset, "limit": limit, "part": part, "keep_duplicates": keep_duplicates}
                images, made_by["part"] = as_images(address, net.image_size, **how, model=split), part
        assert isinstance(images, Stream | ImageSet)
        facts = {**model_facts(net, images.source, images.layout), **made_by, **(origin or {})}
        plan = _plan(net, images, facts, (fit, keep_duplicates), batch_size)
        folder = path.with_name(f"{path.name}.partial")
        if folder.is_dir() or not folder.exists():
            stack.enter_context(locked(folder))
        parts = Parts(folder, plan, fresh=fresh)
        resumed, start = parts.rows, parts.following
        options = {"batch_size": batch_size, "fit": fit}
        if engine == "ray":
            assert isinstance(images, Stream) and reopen is not None
            blocks = ray_blocks(net, images, start, open_stream=reopen, workers=workers or 2, **options)
        else:
            blocks = local_blocks(net, images, start, workers=workers, **options)
        _compute(parts, blocks, keep_duplicates, getattr(images, "limit", None), progress)
        return _finish(parts, path, images, facts, resumed, keep_duplicates)


def unlike_training(images: ImageSet | str | Path, model: Any, **how: Any) -> str:
    """How a sample of images differs from a model's training; "" where it does not, or errors are unknown.

    The line names a bundled model that fits better; ``how`` as for `derender.inputs.as_images`.
    """
    net = as_model(model)
    known = None if net.source is None else read_errors(model_folder(net.source))
    if known is None:
        return ""
    how["limit"] = min(how.get("limit") or LOOKED_AT, LOOKED_AT)
    pixels = as_images(images, net.image_size, **how, model=model).images
    return unlike(pixels, reconstruction_percentile(net, pixels, known))


def _network(model: Any, device: str, fit_steps: int | None) -> tuple[Any, dict[str, Any]]:
    """The network, and how the table's origin names its source."""
    if isinstance(model, str | Path):
        return as_model(model, device=device, fit_steps=fit_steps), {"source": str(model)}
    return (as_model(model, fit_steps=fit_steps) if fit_steps is not None else model), {}


def _plan(net: Any, images: Source, facts: Facts, reading: object, batch_size: int) -> Facts:
    """Everything that a resumed run must have in common with the one before."""
    if isinstance(images, ImageSet):
        check_size(net, images.images)
        labels = {name: column.tolist() for name, column in images.labels.items()}
        content: object = (images.files, labels, sample_checksum(images.images))
    else:
        content = (images.place, images.identity(), images.limit, reading, READER_VERSION)
    digest = hashlib.sha256(repr((PIL.__version__, content)).encode("utf-8", "replace")).hexdigest()
    machine = {"device": str(net.device), "torch": torch.__version__}
    sizes = {"image_size": net.image_size, "batch_size": batch_size, "format": PARTS_FORMAT}
    return {"origin": facts, "pictures": digest, **sizes, **machine}


def _compute(parts: Parts, blocks: Any, keep: bool, limit: int | None, progress: Progress | None) -> None:
    """Write the parts that are missing; what is computed is kept, and no folder stays without a part."""
    waiting: list[Rows] = []
    try:
        with blocks as made, ThreadPoolExecutor(1, thread_name_prefix="write") as pool:

            def write() -> None:
                if rows := waiting.copy():
                    waiting.clear()
                    pool.submit(parts.write, rows).result()  # in a thread that Ctrl-C does not stop

            seen = set(parts.column("digest"))
            try:
                for block in made:
                    waiting.append(rows_of(block, seen, keep))
                    if sum(len(table) for table, _ in waiting) >= PART_ROWS:
                        write()
                    if progress is not None:
                        done, share = block[0][-1].number + 1, block[0][-1].share
                        progress(done, estimated_total(done, share, limit))
            finally:
                write()
    except BaseException as stopped:
        if not parts.files:
            shutil.rmtree(parts.folder, ignore_errors=True)
        elif isinstance(stopped, KeyboardInterrupt):
            kept = f"{parts.rows:,} rows are kept in {parts.folder}: the same command continues from there"
            raise KeyboardInterrupt(f"stopped by Ctrl-C; {kept}") from stopped
        raise
    if progress is not None:
        progress(parts.following, parts.following)


def _finish(parts: Parts, path: Path, images: Source, facts: Facts, resumed: int, kept: bool) -> Embedded:
    """Put the parts together, then delete them."""
    skipped = (*(images.passed_over if isinstance(images, Stream) else ()), *parts.skipped)
    if not parts.rows:
        shutil.rmtree(parts.folder, ignore_errors=True)
        more = f"; the first is {parts.skipped[0].file!r}: {parts.skipped[0].reason}" if parts.skipped else ""
        raise ValueError(f"no image in {images.source} ({images.layout}) can be read{more}")
    source = images if isinstance(images, ImageSet) else images.table
    tables = parts.tables(facts, None if source is None else table_labels(source))
    first = next(tables)
    write_tables(path, chain([first], tables))
    shutil.rmtree(parts.folder, ignore_errors=True)
    widths = {name: values.shape[1] for name, values in first.factors.items()}
    counts = (len(skipped), skipped[:LISTED_SKIPPED], parts.copies, resumed)
    of = images.source, images.layout
    return Embedded(path, parts.rows, widths, tuple(first.labels), facts, *counts, *of, kept)
