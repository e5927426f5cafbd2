"""A stream in blocks of consecutive images: embedded in order, here or on a cluster, and kept in parts.

In this process a pool decodes ahead of the model. With Ray Data, actors each open the stream themselves; only
features, names, labels and digests of pixels travel. Rows are the same bits.

An unfinished table is a folder of parts, each written atomically, for a later run to resume. ``plan.json`` is
what they are made of. A part holds some thousand rows, their positions and digests of pixels, and where to
continue. The checksum of a part is in its name: one that is damaged or missing is made again, with those
after it. Labels of a stream stay as JSON until their kinds are known, at the end.
"""

import json
import logging
import pickle
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch

from derender.data import ImageSet, Skipped, Unreadable, quiet_pillow
from derender.data.stream import Decoded, Sample, Stream, column_of, decode_samples, decoded, kinds_of
from derender.features.extract import as_batch, factor_codes
from derender.features.parquet import factor_column, factor_values
from derender.features.table import FeatureTable, check_finite
from derender.storage.atomic import Damaged, DamageNoticed, atomic_file, measured, write_whole
from derender.storage.bounded import parse_json, read_json
from derender.storage.places import optional
from derender.training.process import LOCK_FILE, evaluating

OpenStream = Callable[[], AbstractContextManager[Stream]]  # opens the stream anew, in whatever process
Block = tuple[list[Decoded], Mapping[str, np.ndarray]]
"""Consecutive samples without their pixels, and the features by factor of those that could be read."""


def embedded_block(model: Any, chunk: Sequence[Decoded]) -> Block:
    """The features of decoded samples; the model is in evaluation mode."""
    good = [one.pixels for one in chunk if one.pixels is not None]
    codes = factor_codes(model, as_batch(np.stack(good), model.device)) if good else {}
    return [one._replace(pixels=None) for one in chunk], codes


@contextmanager
def local_blocks(
    model: Any, source: Stream | ImageSet, start: int, *, batch_size: int, fit: str = "crop",
    workers: int | None = None,
) -> Iterator[Iterator[Block]]:  # fmt: skip
    """The blocks from sample ``start`` on, computed in this process while a pool decodes ahead."""
    with quiet_pillow(), evaluating(model), torch.inference_mode(), ExitStack() as stack:
        if isinstance(source, ImageSet):
            pairs = enumerate(zip(source.files, source.images, strict=True))
            samples = (
                Decoded(row, file, pixels, b"", {}, "", (row + 1) / len(source))
                for row, (file, pixels) in islice(pairs, start, None)
            )
        else:
            pixels = decoded(source, model.image_size, fit=fit, start=start, workers=workers)
            samples = chain.from_iterable(stack.enter_context(closing(pixels)))
        yield (embedded_block(model, batch) for batch in iter(lambda: list(islice(samples, batch_size)), []))


class BlockEmbedder:
    """Embeds blocks of ``size`` samples; best in ascending order, as it reads the stream through once."""

    def __init__(self, model: Any, open_stream: OpenStream, size: int, fit: str = "crop"):
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
        with quiet_pillow(), evaluating(self.model), torch.inference_mode():
            return embedded_block(self.model, decode_samples(start, samples, self.model.image_size, self.fit))

    def __call__(self, numbers: dict[str, Any]) -> dict[str, list[bytes]]:
        """As Ray Data calls it, on one core: the first samples of blocks in, pickled blocks out."""
        torch.set_num_threads(1)
        return {"block": [pickle.dumps(self.embed(int(start))) for start in numbers["start"]]}


@contextmanager
def ray_blocks(
    model: Any, stream: Stream, start: int, *, open_stream: OpenStream, batch_size: int, fit: str = "crop",
    workers: int = 2,
) -> Iterator[Iterator[Block]]:  # fmt: skip
    """As ``local_blocks``, with ``workers`` actors of one core each, or of one GPU each for a model on one.

    Ray starts an actor anew when its process or machine dies, and gives its block to another. Every machine
    must be able to open the data under the same name. Without a cluster (``ray start``, RAY_ADDRESS) the
    actors are processes on this machine. A ValueError: Ray is not installed.
    """
    ray = optional("ray", "engine 'ray'", "ray")
    optional("ray.data", "engine 'ray'", "ray")
    left = None if stream.limit is None else max(0, stream.limit - start)
    end = start + sum(1 for _ in islice(stream.samples(start), left))
    starts = [{"start": first} for first in range(start, end, batch_size)]

    def blocks() -> Iterator[Block]:
        made = ray.data.from_items(starts, override_num_blocks=len(starts)).map_batches(
            BlockEmbedder,
            fn_constructor_args=(model, open_stream, batch_size, fit),
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


PLAN, PARTS_FORMAT = "plan.json", 2
_KEY = b"derender part"
# of a run killed before its first part
_BEGUN = (LOCK_FILE, PLAN, f".{PLAN}", "writing.parquet", ".writing.parquet")

Rows = tuple[pa.Table, Mapping[str, Any]]
"""Rows of an unfinished table, and what else is known: the first sample ``following``, unreadable images
(``skipped``: name and reason), and the number of ``copies``."""


def rows_of(block: Block, seen: set[bytes], keep_duplicates: bool = False) -> Rows:
    """The rows of a block in the order of the stream; copies are dropped, unless they are kept.

    ``seen`` holds the digests of the images before, and grows. A feature that is not finite is an error.
    """
    chunk, codes = block
    kept: dict[int, Decoded] = {}  # by their place among the images that could be read
    copies, skipped = 0, []
    for place, one in enumerate(chunk):
        if isinstance(one.outcome, Unreadable):
            skipped.append((one.file, str(one.outcome)))
            continue
        copy = one.outcome in seen and one.outcome != b""  # copies are dropped from a set when it is read
        if keep_duplicates or not copy:
            kept[place - len(skipped)] = one
        copies += copy
        seen.add(one.outcome)
    rows = kept.values()
    files = [one.file for one in rows]
    factors = {name: values[list(kept)] for name, values in codes.items()} if kept else {}
    check_finite(factors, files)
    labels = [({"partition": one.partition} if one.partition else {}) | dict(one.labels) for one in rows]
    columns = {
        "file": pa.array(files, pa.string()),
        "position": pa.array([one.number for one in rows], pa.int64()),
        "digest": pa.array([one.outcome for one in rows], pa.binary()),
        "labels": pa.array([json.dumps(one, ensure_ascii=False) for one in labels], pa.string()),
        **{f"factor {name}": factor_column(values) for name, values in factors.items()},
    }
    return pa.table(columns), {"following": chunk[-1].number + 1, "skipped": skipped, "copies": copies}


class Parts:
    """A folder of parts, made of ``plan`` (JSON). Parts of another plan are an error, or go if ``fresh``.

    Attributes:
        following: the first sample that is in no part.
        rows, copies, skipped: rows so far, copies that were dropped, images that could not be read.
    """

    def __init__(self, folder: Path, plan: Mapping[str, Any], *, fresh: bool = False):
        self.folder, self.files = folder, list[Path]()
        self.following = self.rows = self.copies = 0
        self.skipped: list[Skipped] = []
        if folder.exists():
            self._require(json.loads(json.dumps(plan)), fresh)
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(folder / PLAN, json.dumps(plan))
        files = sorted(folder.glob("part-*.parquet"))
        for number, file in enumerate(files):
            try:
                self._add(file, *_checked(file, number))
            except Damaged as problem:
                text = f"{file} is damaged ({problem}): going on from the {self.rows:,} rows before it"
                warnings.warn(text, DamageNoticed, stacklevel=2)
                for rest in files[number:]:
                    rest.unlink()
                break

    def _require(self, plan: dict[str, Any], fresh: bool) -> None:
        """Delete the folder if it is of another plan and may go; otherwise that is an error."""
        if not self.folder.is_dir():
            raise ValueError(f"{self.folder} is in the way: delete it")
        try:
            stored = read_json(self.folder / PLAN, dict[str, Any])
        except (OSError, ValueError):
            stored = None
        if stored == plan:
            return
        if not fresh and any(not entry.name.startswith(_BEGUN) for entry in self.folder.iterdir()):
            how = f"without a sound {PLAN}"
            if stored is not None:
                differs = ", ".join(name for name in plan if stored.get(name) != plan[name])
                how = f"that was made otherwise (differs in {differs or 'its version'})"
            raise ValueError(f"{self.folder} holds an unfinished table {how}: delete it, or add --force")
        for entry in self.folder.iterdir():
            if entry.name != LOCK_FILE:
                entry.unlink()

    def _add(self, file: Path, rows: int, note: Mapping[str, Any]) -> None:
        self.files.append(file)
        self.rows, self.following = self.rows + rows, note["following"]
        self.copies += note["copies"]
        self.skipped += [Skipped(*one) for one in note["skipped"]]

    def column(self, name: str) -> Iterator[Any]:
        """The values of one column of the parts, such as "digest"."""
        for file in self.files:
            yield from pq.read_table(file, columns=[name])[name].to_pylist()

    def write(self, blocks: Sequence[Rows]) -> None:
        """Add a part: the rows of blocks in order."""
        skipped = [one for _, note in blocks for one in note["skipped"]]
        copies = sum(note["copies"] for _, note in blocks)
        note = {"following": blocks[-1][1]["following"], "skipped": skipped, "copies": copies}
        table = pa.concat_tables([table for table, _ in blocks if len(table)] or [blocks[0][0]])
        table = table.replace_schema_metadata({_KEY: json.dumps(note).encode()})
        with atomic_file(self.folder / "writing.parquet", durable=True) as temporary:
            pq.write_table(table, temporary, use_dictionary=False)
            name = f"part-{len(self.files):06d}-{measured(temporary)[1]:08x}.parquet"
        self._add((self.folder / "writing.parquet").rename(self.folder / name), len(table), note)
        del table
        pa.default_memory_pool().release_unused()

    def tables(self, origin: Mapping[str, Any], known: Mapping[str, Any] | None) -> Iterator[FeatureTable]:
        """The finished table, part by part; labels are the ``known`` ones of all images, or the stream's."""
        texts = self.column("labels") if known is None else ()
        kinds = kinds_of(map(json.loads, texts))
        names = sorted(kinds, key="partition".__ne__)  # the owners' split first
        for file in self.files:
            table = pq.read_table(file)
            if not len(table):
                continue
            own = [name for name in table.column_names if name.startswith("factor ")]
            factors = {name.removeprefix("factor "): factor_values(table[name], name, file) for name in own}
            if known is not None:
                places = table["position"].to_numpy()
                labels = {name: column[places] for name, column in known.items()}
            else:
                rows = [json.loads(text) for text in table["labels"].to_pylist()]
                labels = {name: column_of((row.get(name) for row in rows), kinds[name]) for name in names}
            yield FeatureTable(tuple(table["file"].to_pylist()), factors, labels, origin)


def _checked(file: Path, number: int) -> tuple[int, dict[str, Any]]:
    """Rows and note of a part; ``Damaged`` if it is not the part of this number, as it was written."""
    name = re.fullmatch(r"part-(\d{6})-([0-9a-f]{8})", file.stem)
    if name is None or int(name[1]) != number:
        raise Damaged(f"part {number} is missing")
    if measured(file)[1] != int(name[2], 16):
        raise Damaged("its checksum differs")
    metadata = pq.read_metadata(file)
    return metadata.num_rows, parse_json((metadata.metadata or {})[_KEY], dict[str, Any])
