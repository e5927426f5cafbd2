"""A feature table that is not finished: a folder of parts, each written whole, for a later run to go on with.

``plan.json`` says what is being made; a part holds some thousand rows, what a resumed run has to know of them
(positions, digests of pixels), and where to go on. The checksum of a part stands in its name: one that is
damaged or missing is made again, with those after it. Labels that came with a stream stay as JSON until their
kinds are known, at the end.
"""

import json
import re
import shutil
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from derender.data import Kind, Kinds, SeenPixels, Skipped, column_of
from derender.features.blocks import Rows
from derender.features.parquet import Columns, factor_column
from derender.storage.atomic import Damaged, DamageNoticed, atomic_file, measured

PLAN = "plan.json"
LISTED_SKIPPED = 20
"""So many unreadable pictures of each part are remembered by name; all are counted."""

_KEY = b"derender part"
_NAME = re.compile(r"part-(\d{6})(?:-([0-9a-f]{8}))?\.parquet")  # earlier versions wrote no checksum
_OURS = ("file", "position", "digest", "partition", "labels")


@dataclass
class Progressed:
    """How far the parts go.

    Attributes:
        following: the number of the first picture that is in no part.
        rows: rows in all parts.
        skipped: unreadable pictures so far; the first few by name in ``examples``.
        copies: identical copies so far.
        kinds: of labels that came with the stream.
        partitioned: whether any row knows its partition.
    """

    following: int = 0
    rows: int = 0
    skipped: int = 0
    examples: list[Skipped] = field(default_factory=list)
    copies: int = 0
    kinds: Kinds = field(default_factory=Kinds)
    partitioned: bool = False


class Parts:
    """A folder of parts.

    Args:
        folder: where; made if it is not there.
        plan: what is being made: anything JSON can hold.
        fresh: delete parts that were made to another plan; otherwise they are an error.
    """

    def __init__(self, folder: Path, plan: Mapping[str, Any], *, fresh: bool = False):
        self.folder = folder
        self.so_far = Progressed()
        plan = json.loads(json.dumps(plan))
        if folder.exists() and not folder.is_dir():
            raise ValueError(f"{folder} is in the way: delete it")
        found = _plan_of(folder)
        if folder.exists() and found != plan:
            if not fresh and any(not _begun(entry.name) for entry in folder.iterdir()):
                differs = [name for name in plan if (found or {}).get(name) != plan[name]]
                how = f"that was made otherwise (differs in {', '.join(differs) or 'its version'})"
                raise ValueError(
                    f"{folder} holds an unfinished table {how if found else f'without a sound {PLAN}'}: "
                    "delete that folder, or add --force to begin anew"
                )
            shutil.rmtree(folder)
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_file(folder / PLAN) as temporary:
            temporary.write_text(json.dumps(plan))
        self.files: list[Path] = []
        self._join_all(sorted(folder.glob("part-*.parquet")))

    def seen(self) -> SeenPixels:
        """The pixels of every row there is."""
        seen = SeenPixels()
        for file in self.files:
            table = pq.read_table(file, columns=["digest", "position"])
            seen.first(table["digest"].to_pylist(), table["position"].to_pylist())
        return seen

    def write(self, batches: list[Rows], factors: list[Mapping[str, np.ndarray]]) -> None:
        """Add a part: the rows of batches in order, and the features of each by factor, (n, D)."""
        kinds = Kinds()
        for batch in batches:
            for labels in batch.labels:
                kinds.see(labels)
        skipped = [row for batch in batches for row in batch.skipped]
        note = {
            "following": batches[-1].following,
            "skipped": len(skipped),
            "examples": [[row.file, row.reason] for row in skipped[:LISTED_SKIPPED]],
            "copies": sum(batch.copies for batch in batches),
            "kinds": kinds,
            "partitioned": any(any(batch.partitions) for batch in batches),
            "rows": sum(len(batch.files) for batch in batches),
        }
        columns: dict[str, pa.Array] = {
            "file": pa.array([file for batch in batches for file in batch.files], pa.string()),
            "position": pa.array(np.concatenate([batch.positions for batch in batches])),
            "digest": pa.array([digest for batch in batches for digest in batch.digests], pa.binary()),
            "partition": pa.array([one for batch in batches for one in batch.partitions], pa.string()),
            "labels": pa.array([_packed(one) for batch in batches for one in batch.labels], pa.string()),
        }
        for name in factors[0] if factors else ():
            columns[f"factor {name}"] = factor_column(np.concatenate([codes[name] for codes in factors]))
        table = pa.table(columns).replace_schema_metadata({_KEY: json.dumps(note).encode()})
        with atomic_file(self.folder / "writing.parquet", durable=True) as temporary:
            pq.write_table(table, temporary, use_dictionary=False)
            name = f"part-{len(self.files):06d}-{measured(temporary)[1]:08x}.parquet"
        file = (self.folder / "writing.parquet").rename(self.folder / name)
        del table, columns
        pa.default_memory_pool().release_unused()
        self.files.append(file)
        self._join(note)

    def columns(
        self,
        origin: Mapping[str, Any],
        known: Callable[[np.ndarray], dict[str, np.ndarray]] | None,
    ) -> Iterator[Columns]:
        """The finished table, part by part.

        Args:
            origin: where it comes from.
            known: labels by the rows' positions, where they were known beforehand; None: they came along.
        """
        for file in self.files:
            table = pq.read_table(file)
            if not len(table):
                continue
            factors = {}
            for name in table.column_names:
                if name not in _OURS:
                    values = table[name].combine_chunks()
                    width = values.type.list_size
                    factors[name.removeprefix("factor ")] = values.flatten().to_numpy().reshape(-1, width)
            labels = self._labels(table) if known is None else known(table["position"].to_numpy())
            yield Columns(table["file"].to_pylist(), factors, labels, origin)

    def remove(self) -> None:
        """Delete the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def remove_if_empty(self) -> bool:
        """Delete the folder if it holds nothing to go on from; says whether that was so."""
        if not self.files:
            self.remove()
        return not self.files

    def _join_all(self, files: list[Path]) -> None:
        """Take up parts in order, up to the first that is not as it was written; that and later ones go."""
        for number, file in enumerate(files):
            try:
                self._join(_checked_note(file, number))
                self.files.append(file)
            except Damaged as problem:
                warnings.warn(
                    f"{file} is damaged ({problem}): going on from the {self.so_far.rows:,} rows before it",
                    DamageNoticed,
                    stacklevel=2,
                )
                for rest in files[number:]:
                    rest.unlink()
                return

    def _labels(self, table: pa.Table) -> dict[str, np.ndarray]:
        rows = [json.loads(text) if text else {} for text in table["labels"].to_pylist()]
        labels = {}
        if self.so_far.partitioned:
            labels["partition"] = np.array(table["partition"].to_pylist(), np.str_)
        return {**labels, **{name: column_of(name, rows, kind) for name, kind in self.so_far.kinds.items()}}

    def _join(self, note: Mapping[str, Any]) -> None:
        so_far = self.so_far
        so_far.following = note["following"]
        so_far.rows += note["rows"]
        so_far.skipped += note["skipped"]
        so_far.copies += note["copies"]
        so_far.partitioned |= note["partitioned"]
        examples = [Skipped(*row) for row in note["examples"]]
        so_far.examples = (so_far.examples + examples)[:LISTED_SKIPPED]
        for name, kind in note["kinds"].items():
            so_far.kinds.join(name, None if kind is None else Kind(kind))


def _packed(labels: Mapping[str, Any]) -> str:
    return json.dumps(dict(labels), ensure_ascii=False) if labels else ""


def _begun(name: str) -> bool:
    """Whether a file is what a run leaves that was killed before its first part."""
    return name.startswith((PLAN, f".{PLAN}", "writing.parquet", ".writing.parquet"))


def _plan_of(folder: Path) -> dict[str, Any] | None:
    try:
        plan = json.loads((folder / PLAN).read_text())
    except (OSError, ValueError):
        return None
    return plan if isinstance(plan, dict) else None


def _checked_note(file: Path, number: int) -> dict[str, Any]:
    """What a part says of itself; ``Damaged`` if it is not the part of this number, as it was written."""
    name = _NAME.fullmatch(file.name)
    if name is None or int(name[1]) != number:
        raise Damaged(f"part {number} is missing")
    if name[2] is not None and measured(file)[1] != int(name[2], 16):
        raise Damaged("its checksum differs")
    try:
        note = json.loads((pq.read_schema(file).metadata or {})[_KEY])
        examples = [Skipped(*row) for row in note["examples"]]
        Progressed(note["following"], note["rows"], note["skipped"], examples, note["copies"])
    except (pa.ArrowException, OSError, ValueError, LookupError, TypeError) as error:
        raise Damaged("it cannot be read") from error
    return note
