"""A folder, a zip or one picture as a stream: what is in it is known beforehand, its bytes are not kept."""

from collections.abc import Iterator
from functools import partial
from hashlib import sha256
from pathlib import Path

import numpy as np

from derender.data.cache import fingerprint
from derender.data.inventory import Inventory, take_inventory
from derender.data.layout import Table
from derender.data.stream.address import open_stream
from derender.data.stream.sample import Sample, Stream


class ListedStream(Stream):
    """The pictures of an inventory, in its order; closing the stream closes the inventory's source.

    Args:
        inventory: what there is.
        limit: take at most so many, evenly spaced.
    """

    def __init__(self, inventory: Inventory, limit: int | None = None):
        path, subset, table = inventory.source.path, inventory.subset, inventory.table
        if limit is not None and limit < len(table.files):
            table = table.select(np.linspace(0, len(table.files) - 1, limit).astype(int))
        self.inventory = inventory
        self.layout = inventory.layout.name
        self.table = table
        self.source = str(path) if subset is None else f"{path}::{subset}"
        self.passed_over = (*inventory.source.skipped, *inventory.table.skipped)

    def samples(self, start: int = 0) -> Iterator[Sample]:
        table, source = self._known, self.inventory.source
        for row in range(start, len(table.files)):
            file, box = table.files[row], None if table.boxes is None else table.boxes[row]
            yield Sample(file, partial(source.read, file), (row + 1) / len(table.files), box=box)

    def identity(self) -> object:
        table, source = self._known, self.inventory.source
        boxes = None if table.boxes is None else sha256(table.boxes.tobytes()).hexdigest()
        return fingerprint(source, table.files, (self.layout, boxes))

    @property
    def _known(self) -> Table:
        assert self.table is not None
        return self.table

    def close(self) -> None:
        self.inventory.source.close()


def stream_of(source: str | Path, *, dataset: str = "auto", limit: int | None = None) -> Stream:
    """Any source as a stream; close it after use.

    Args:
        source: a folder, zip, picture, shards or Hugging Face data set.
        dataset: the layout's name, or "auto" to recognise it.
        limit: at most so many pictures: evenly spaced where it is known what there is, else the first.
    """
    stream = open_stream(source, dataset=dataset)
    if stream is None:
        return ListedStream(take_inventory(source, dataset=dataset), limit)
    stream.limit = limit
    return stream
