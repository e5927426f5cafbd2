"""Rows of a feature table with their pictures, which are asked for by row number and in no other way.

The files are those that the table's own data set lists; folders, zips and tables of paths are read in place.
Of what comes as a stream only (tar shards, Hugging Face) no picture can be shown, since one is reached only
by reading all before it.
"""

from typing import Any

import numpy as np
from jaxtyping import UInt8

from derender.data import ListedStream, open_images, parse_source
from derender.features import FeatureTable
from derender.report.viewer.intake import pixels_of
from derender.report.viewer.refused import Refused

LABELS_SHOWN = 4


class Gallery:
    """A table and where its pictures lie.

    Args:
        table: made by ``derender embed``.
        source: where the pictures lie; what the table says if None.
        dataset: the layout's name, or "auto".

    Attributes:
        without_pictures: why none can be shown, or "".
    """

    def __init__(self, table: FeatureTable, source: str | None = None, dataset: str = "auto"):
        self.table = table
        self.without_pictures = ""
        self._listed: ListedStream | None = None
        place = source if source is not None else str(table.origin.get("data", ""))
        try:
            self._listed = _listed(place, dataset)
        except (ValueError, OSError) as problem:
            if source is not None:
                raise
            self.without_pictures = " ".join(str(problem).split())
        files = () if self._listed is None else self._listed.table.files
        self._position = {file: row for row, file in enumerate(files)}
        if source is not None and not any(file in self._position for file in table.files):
            raise ValueError(f"{source} holds none of the table's pictures, such as {table.files[0]!r}")

    def about(self, row: int) -> dict[str, Any]:
        """Name and labels of a row, as text."""
        labels = [name for name in self.table.labels if name != "partition"][:LABELS_SHOWN]
        return {
            "row": row,
            "file": self.table.files[row],
            "labels": {name: str(self.table.labels[name][row]) for name in labels},
        }

    def picture(self, row: int, size: int) -> UInt8[np.ndarray, "3 s s"]:
        """The picture of a row; ``Refused`` (404, 413, 415) where it cannot be shown."""
        if not 0 <= row < len(self.table):
            raise Refused(404, f"the table has {len(self.table):,} rows, there is no row {row}")
        file = self.table.files[row]
        if self._listed is None or file not in self._position:
            raise Refused(404, "the picture of this row is not here: name its place with --data")
        boxes = self._listed.table.boxes
        box = None if boxes is None else boxes[self._position[file]]
        try:
            encoded = self._listed.files.read(file)
        except (ValueError, OSError) as problem:
            raise Refused(404, "the picture of this row can no longer be read") from problem
        return pixels_of(encoded, size, box)

    def close(self) -> None:
        if self._listed is not None:
            self._listed.close()


def _listed(place: str, dataset: str) -> ListedStream:
    if not place:
        raise ValueError("the table does not say where its pictures lie: name the place with --data")
    if not parse_source(place)[0].exists():
        raise ValueError(f"{place} is not here: name the place of the pictures with --data")
    stream = open_images(place, dataset=dataset)
    if isinstance(stream, ListedStream):
        return stream
    stream.close()
    raise ValueError(f"{place} can only be read from its beginning: pictures of rows are not shown")
