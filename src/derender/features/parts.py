"""An unfinished feature table: a folder of parts, each written atomically, for a later run to resume.

``plan.json`` is what the parts are made of. A part holds some thousand rows, what a resumed run needs of them
(positions, digests of pixels), and where to continue. The checksum of a part is in its name: one that is
damaged or missing is made again, with those after it. Labels that came with a stream stay as JSON until their
kinds are known, at the end.
"""

import json
import re
import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from derender.data import Kinds, Skipped, Unreadable, column_of
from derender.features.blocks import Block
from derender.features.parquet import Columns, factor_column, factor_values
from derender.features.table import check_finite
from derender.storage.atomic import Damaged, DamageNoticed, atomic_file, measured
from derender.storage.bounded import parse_json, read_json

PLAN, PARTS_FORMAT = "plan.json", 2
_KEY = b"derender part"
_BEGUN = (PLAN, f".{PLAN}", "writing.parquet", ".writing.parquet")  # of a run killed before its first part

Rows = tuple[pa.Table, Mapping[str, Any]]
"""Rows of an unfinished table, and what else is known: the first sample ``following``, unreadable images
(``skipped``: name and reason), and the number of ``copies``."""


def rows_of(block: Block, seen: set[bytes], keep_duplicates: bool = False) -> Rows:
    """The rows of a block in the order of the stream; copies are dropped, unless they are kept.

    ``seen`` holds the digests of the images before, and grows. A feature that is not finite is an error.
    """
    chunk, codes = block
    digests, kept, copies, skipped = [], [], 0, []
    for row, outcome in enumerate(chunk.outcomes):
        if isinstance(outcome, Unreadable):
            skipped.append((chunk.files[row], str(outcome)))
            continue
        copy = outcome in seen and outcome != b""  # copies are dropped from a set when it is read
        if keep_duplicates or not copy:
            kept.append((row, len(digests)))
        copies += copy
        digests.append(outcome)
        seen.add(outcome)
    rows, places = [row for row, _ in kept], [place for _, place in kept]
    files = [chunk.files[row] for row in rows]
    factors = {name: values[places] for name, values in codes.items()} if rows else {}
    check_finite(factors, files)
    labels = [
        ({"partition": chunk.partitions[row]} if chunk.partitions[row] else {}) | dict(chunk.labels[row])
        for row in rows
    ]
    columns = {
        "file": pa.array(files, pa.string()),
        "position": pa.array([chunk.start + row for row in rows], pa.int64()),
        "digest": pa.array([digests[place] for place in places], pa.binary()),
        "labels": pa.array([json.dumps(one, ensure_ascii=False) for one in labels], pa.string()),
        **{f"factor {name}": factor_column(values) for name, values in factors.items()},
    }
    return pa.table(columns), {"following": chunk.start + len(chunk), "skipped": skipped, "copies": copies}


class Parts:
    """A folder of parts.

    Args:
        folder: where; made if it is not there.
        plan: what they are made of: anything JSON can hold.
        fresh: delete parts of another plan; otherwise they are an error.

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
        with atomic_file(folder / PLAN) as temporary:
            temporary.write_text(json.dumps(plan))
        files = sorted(folder.glob("part-*.parquet"))
        for number, file in enumerate(files):
            try:
                self._add(file, *_checked(file, number))
            except Damaged as problem:
                went_on = f"going on from the {self.rows:,} rows before it"
                warnings.warn(f"{file} is damaged ({problem}): {went_on}", DamageNoticed, stacklevel=2)
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
            raise ValueError(
                f"{self.folder} holds an unfinished table {how}: delete that folder, or add --force to "
                "begin anew"
            )
        self.remove()

    def _add(self, file: Path, rows: int, note: Mapping[str, Any]) -> None:
        self.files.append(file)
        self.rows, self.following = self.rows + rows, note["following"]
        self.copies += note["copies"]
        self.skipped += [Skipped(*one) for one in note["skipped"]]

    def seen(self) -> set[bytes]:
        """The digests of every row there is."""
        return {digest for (column,) in self._read("digest") for digest in column.to_pylist()}

    def _read(self, *columns: str) -> Iterator[list[pa.ChunkedArray]]:
        for file in self.files:
            yield pq.read_table(file, columns=list(columns)).columns

    def write(self, blocks: Sequence[Rows]) -> None:
        """Add a part: the rows of blocks in order."""
        notes = [note for _, note in blocks]
        note = {
            "following": notes[-1]["following"],
            "skipped": [one for note in notes for one in note["skipped"]],
            "copies": sum(note["copies"] for note in notes),
        }
        table = pa.concat_tables([table for table, _ in blocks if len(table)] or [blocks[0][0]])
        table = table.replace_schema_metadata({_KEY: json.dumps(note).encode()})
        with atomic_file(self.folder / "writing.parquet", durable=True) as temporary:
            pq.write_table(table, temporary, use_dictionary=False)
            name = f"part-{len(self.files):06d}-{measured(temporary)[1]:08x}.parquet"
        self._add((self.folder / "writing.parquet").rename(self.folder / name), len(table), note)
        del table
        pa.default_memory_pool().release_unused()

    def columns(self, origin: Mapping[str, Any], known: Mapping[str, np.ndarray] | None) -> Iterator[Columns]:
        """The finished table, part by part.

        Args:
            origin: where it comes from.
            known: labels of all images, where they were known beforehand; None: the stream's.
        """
        kinds = Kinds()
        for (texts,) in self._read("labels") if known is None else ():
            for text in texts.to_pylist():
                kinds.see(json.loads(text))
        names = sorted(kinds, key="partition".__ne__)  # the owners' split first
        for file in self.files:
            table = pq.read_table(file)
            if not len(table):
                continue
            factors = {
                name.removeprefix("factor "): factor_values(table[name], name, file)
                for name in table.column_names
                if name.startswith("factor ")
            }
            if known is not None:
                places = table["position"].to_numpy()
                labels = {name: column[places] for name, column in known.items()}
            else:
                rows = [json.loads(text) for text in table["labels"].to_pylist()]
                labels = {name: column_of(name, rows, kinds[name]) for name in names}
            yield Columns(table["file"].to_pylist(), factors, labels, origin)

    def remove(self) -> None:
        """Delete the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)


def _checked(file: Path, number: int) -> tuple[int, dict[str, Any]]:
    """Rows and note of a part; ``Damaged`` if it is not the part of this number, as it was written."""
    name = re.fullmatch(r"part-(\d{6})-([0-9a-f]{8})", file.stem)
    if name is None or int(name[1]) != number:
        raise Damaged(f"part {number} is missing")
    if measured(file)[1] != int(name[2], 16):
        raise Damaged("its checksum differs")
    metadata = pq.read_metadata(file)
    return metadata.num_rows, parse_json((metadata.metadata or {})[_KEY], dict[str, Any])
