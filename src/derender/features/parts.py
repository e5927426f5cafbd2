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
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from derender.data import Kinds, SeenPixels, Skipped, column_of
from derender.features.blocks import TableRows
from derender.features.parquet import Columns, factor_column
from derender.storage.atomic import Damaged, DamageNoticed, atomic_file, measured

PLAN = "plan.json"
LISTED_SKIPPED = 20
"""So many unreadable images are remembered by name; all are counted."""

_KEY = b"derender part"
_NAME = re.compile(r"part-(\d{6})(?:-([0-9a-f]{8}))?\.parquet")  # earlier versions wrote no checksum
_BEGUN = (
    PLAN,
    f".{PLAN}",
    "writing.parquet",
    ".writing.parquet",
)  # left by a run killed before its first part


@dataclass
class Progressed:
    """How far the parts go.

    Attributes:
        following: the number of the first image that is in no part.
        rows: rows in all parts.
        skipped: unreadable images so far; the first few by name in ``examples``.
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

    def join(self, note: Mapping[str, Any]) -> None:
        """Take the note of one more part into account."""
        examples = [Skipped(*row) for row in note["examples"]]
        self.following = note["following"]
        for name in ("rows", "skipped", "copies"):
            setattr(self, name, getattr(self, name) + note[name])
        self.partitioned |= note["partitioned"]
        self.examples = (self.examples + examples)[:LISTED_SKIPPED]
        for name, kind in note["kinds"].items():
            self.kinds.join(name, kind)


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
            stored = json.loads((self.folder / PLAN).read_text())
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

    def seen(self) -> SeenPixels:
        """The pixels of every row there is."""
        seen = SeenPixels()
        for file in self.files:
            table = pq.read_table(file, columns=["digest", "position"])
            seen.first(table["digest"].to_pylist(), table["position"].to_pylist())
        return seen

    def write(self, batches: list[TableRows], factors: list[Mapping[str, np.ndarray]]) -> None:
        """Add a part: the rows of batches in order, and the features of each by factor, (n, D)."""
        kinds = Kinds()
        for labels in (labels for batch in batches for labels in batch.labels):
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
        self.files.append((self.folder / "writing.parquet").rename(self.folder / name))
        del table, columns
        pa.default_memory_pool().release_unused()
        self.so_far.join(note)

    def columns(
        self, origin: Mapping[str, Any], known: Callable[[np.ndarray], dict[str, np.ndarray]] | None
    ) -> Iterator[Columns]:
        """The finished table, part by part.

        Args:
            origin: where it comes from.
            known: labels by the rows' positions, where they were known beforehand; None: the stream's.
        """
        for table in map(pq.read_table, self.files):
            if not len(table):
                continue
            factors = {}
            for name in table.column_names:
                if name.startswith("factor "):
                    values = table[name].combine_chunks()
                    width = values.type.list_size
                    factors[name.removeprefix("factor ")] = values.flatten().to_numpy().reshape(-1, width)
            labels = self._labels(table) if known is None else known(table["position"].to_numpy())
            yield Columns(table["file"].to_pylist(), factors, labels, origin)

    def remove(self) -> None:
        """Delete the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def remove_if_empty(self) -> bool:
        """Delete the folder if it holds nothing to go on from, and return whether that was so."""
        if not self.files:
            self.remove()
        return not self.files

    def _labels(self, table: pa.Table) -> dict[str, np.ndarray]:
        rows = [json.loads(text) if text else {} for text in table["labels"].to_pylist()]
        labels = {}
        if self.so_far.partitioned:
            labels["partition"] = np.array(table["partition"].to_pylist(), np.str_)
        return {**labels, **{name: column_of(name, rows, kind) for name, kind in self.so_far.kinds.items()}}


def _packed(labels: Mapping[str, Any]) -> str:
    return json.dumps(dict(labels), ensure_ascii=False) if labels else ""


def _checked_note(file: Path, number: int) -> dict[str, Any]:
    """The note of a part; ``Damaged`` if it is not the part of this number, as it was written."""
    name = _NAME.fullmatch(file.name)
    if name is None or int(name[1]) != number:
        raise Damaged(f"part {number} is missing")
    if name[2] is not None and measured(file)[1] != int(name[2], 16):
        raise Damaged("its checksum differs")
    try:
        note = json.loads((pq.read_schema(file).metadata or {})[_KEY])
        Progressed().join(note)
    except (pa.ArrowException, OSError, ValueError, LookupError, TypeError) as error:
        raise Damaged("it cannot be read") from error
    return note
