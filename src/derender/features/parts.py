"""An unfinished feature table: a folder of parts, each written atomically, for a later run to go on with.

``plan.json`` is what the parts are made of; a part holds some thousand rows, what a resumed run needs of them
(positions, digests of pixels), and where to go on. The checksum of a part is in its name: one that is
damaged or missing is made again, with those after it. Labels that came with a stream stay as JSON until their
kinds are known, at the end.
"""

import json
import re
import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from derender.data import Kinds, Unreadable, column_of
from derender.features.blocks import Block
from derender.features.parquet import Columns, factor_column, factor_values
from derender.features.table import check_finite
from derender.storage.atomic import Damaged, DamageNoticed, atomic_file, measured
from derender.storage.bounded import parse_json, read_json

PLAN = "plan.json"
LISTED_SKIPPED = 20
"""So many unreadable images are remembered by name; all are counted."""

_KEY = b"derender part"
_NAME = re.compile(r"part-(\d{6})(?:-([0-9a-f]{8}))?\.parquet")  # earlier versions wrote no checksum
_BEGUN = (PLAN, f".{PLAN}", "writing.parquet", ".writing.parquet")  # of a run killed before its first part

Rows = tuple[pa.Table, Mapping[str, Any]]
"""Rows of an unfinished table, and what `Progressed` counts of them."""


@dataclass
class Progressed:
    """How far the parts go: the first image in no part, rows, unreadable images (a few by name), copies, the
    kinds of labels that came with the stream, and whether any row knows its partition.
    """

    following: int = 0
    rows: int = 0
    skipped: int = 0
    copies: int = 0
    partitioned: bool = False
    examples: list[Sequence[str]] = field(default_factory=list)
    kinds: Kinds = field(default_factory=Kinds)

    def join(self, note: Mapping[str, Any]) -> None:
        """Take the note of further rows into account."""
        self.following = note["following"]
        for name in ("rows", "skipped", "copies"):
            setattr(self, name, getattr(self, name) + note[name])
        self.partitioned |= note["partitioned"]
        self.examples = (self.examples + note["examples"])[:LISTED_SKIPPED]
        for name, kind in note["kinds"].items():
            self.kinds.join(name, kind)


def rows_of(block: Block, seen: set[bytes], keep_duplicates: bool = False) -> Rows:
    """The rows of a block in the order of the stream; copies are dropped, unless they are kept.

    ``seen`` holds the digests of the images before, and grows. A feature that is not finite is an error.
    """
    chunk, codes = block
    good = np.flatnonzero([isinstance(outcome, bytes) for outcome in chunk.outcomes])
    digests = [outcome for outcome in chunk.outcomes if isinstance(outcome, bytes)]
    positions, first = chunk.start + good, np.ones(len(good), bool)
    if digests and digests[0]:  # copies are dropped from a set when it is read
        for place, digest in enumerate(digests):
            first[place] = digest not in seen
            seen.add(digest)
    kept = np.flatnonzero(first | keep_duplicates)
    rows, kinds = good[kept].tolist(), Kinds()
    files, labels = [chunk.files[row] for row in rows], [chunk.labels[row] for row in rows]
    for one in labels:
        kinds.see(one)
    found = {name: values[kept] for name, values in codes.items()} if rows else {}
    check_finite(found, files)
    partitions = [chunk.partitions[row] for row in rows]
    skipped = [
        (file, str(outcome))
        for file, outcome in zip(chunk.files, chunk.outcomes, strict=True)
        if isinstance(outcome, Unreadable)
    ]
    note = {
        "following": chunk.start + len(chunk), "rows": len(rows), "skipped": len(skipped),
        "examples": skipped[:LISTED_SKIPPED], "copies": int((~first).sum()), "kinds": kinds,
        "partitioned": any(partitions),
    }  # fmt: skip
    texts = [json.dumps(dict(one), ensure_ascii=False) if one else "" for one in labels]
    columns = {
        "file": pa.array(files, pa.string()),
        "position": pa.array(positions[kept], pa.int64()),
        "digest": pa.array([digests[row] for row in kept], pa.binary()),
        "partition": pa.array(partitions, pa.string()),
        "labels": pa.array(texts, pa.string()),
        **{f"factor {name}": factor_column(values) for name, values in found.items()},
    }
    return pa.table(columns), note


class Parts:
    """A folder of parts.

    Args:
        folder: where; made if it is not there.
        plan: what they are made of: anything JSON can hold.
        fresh: delete parts of another plan; otherwise they are an error.
    """

    def __init__(self, folder: Path, plan: Mapping[str, Any], *, fresh: bool = False):
        self.folder, self.so_far = folder, Progressed()
        self.files: list[Path] = []
        if folder.exists():
            self._require(json.loads(json.dumps(plan)), fresh)
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_file(folder / PLAN) as temporary:
            temporary.write_text(json.dumps(plan))
        files = sorted(folder.glob("part-*.parquet"))
        for number, file in enumerate(files):
            try:
                self.so_far.join(_checked_note(file, number))
                self.files.append(file)
            except Damaged as problem:
                warnings.warn(
                    f"{file} is damaged ({problem}): going on from the {self.so_far.rows:,} rows before it",
                    DamageNoticed,
                    stacklevel=2,
                )
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
            if isinstance(stored, dict):
                differs = ", ".join(name for name in plan if stored.get(name) != plan[name])
                how = f"that was made otherwise (differs in {differs or 'its version'})"
            raise ValueError(
                f"{self.folder} holds an unfinished table {how}: delete that folder, or add --force to "
                "begin anew"
            )
        self.remove()

    def seen(self) -> set[bytes]:
        """The digests of every row there is."""
        tables = (pq.read_table(file, columns=["digest"]) for file in self.files)
        return {digest for table in tables for digest in table["digest"].to_pylist()}

    def write(self, blocks: Sequence[Rows]) -> None:
        """Add a part: the rows of blocks in order."""
        note = Progressed()
        for _, one in blocks:
            note.join(one)
        table = pa.concat_tables([table for table, _ in blocks if len(table)] or [blocks[0][0]])
        table = table.replace_schema_metadata({_KEY: json.dumps(vars(note)).encode()})
        with atomic_file(self.folder / "writing.parquet", durable=True) as temporary:
            pq.write_table(table, temporary, use_dictionary=False)
            name = f"part-{len(self.files):06d}-{measured(temporary)[1]:08x}.parquet"
        self.files.append((self.folder / "writing.parquet").rename(self.folder / name))
        del table
        pa.default_memory_pool().release_unused()
        self.so_far.join(vars(note))

    def columns(self, origin: Mapping[str, Any], known: Mapping[str, np.ndarray] | None) -> Iterator[Columns]:
        """The finished table, part by part.

        Args:
            origin: where it comes from.
            known: labels of all images, where they were known beforehand; None: the stream's.
        """
        for file in self.files:
            table = pq.read_table(file)
            if not len(table):
                continue
            factors = {
                name.removeprefix("factor "): factor_values(table[name], name, file)
                for name in table.column_names
                if name.startswith("factor ")
            }
            places = table["position"].to_numpy()
            labels = {name: column[places] for name, column in (known or {}).items()}
            labels = self._labels(table) if known is None else labels
            yield Columns(table["file"].to_pylist(), factors, labels, origin)

    def _labels(self, table: pa.Table) -> dict[str, np.ndarray]:
        rows = [json.loads(text) if text else {} for text in table["labels"].to_pylist()]
        labels = {name: column_of(name, rows, kind) for name, kind in self.so_far.kinds.items()}
        if not self.so_far.partitioned:
            return labels
        return {"partition": np.array(table["partition"].to_pylist(), np.str_), **labels}

    def remove(self) -> None:
        """Delete the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def remove_if_empty(self) -> bool:
        """Delete the folder if it holds nothing to go on from, and return whether that was so."""
        if not self.files:
            self.remove()
        return not self.files


def _checked_note(file: Path, number: int) -> dict[str, Any]:
    """The note of a part; ``Damaged`` if it is not the part of this number, as it was written."""
    name = _NAME.fullmatch(file.name)
    if name is None or int(name[1]) != number:
        raise Damaged(f"part {number} is missing")
    if name[2] is not None and measured(file)[1] != int(name[2], 16):
        raise Damaged("its checksum differs")
    try:
        note = parse_json((pq.read_schema(file).metadata or {})[_KEY], dict[str, Any])
        Progressed().join(note)
    except (pa.ArrowException, OSError, ValueError, LookupError, TypeError) as error:
        raise Damaged("it cannot be read") from error
    return note
