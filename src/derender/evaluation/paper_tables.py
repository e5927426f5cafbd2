"""The paper's tables as data: its numbers (paper_tables.csv), and the questions that they answer.

Source: Klinghoffer et al., ECCV 2022, Tables 1 to 4. A part of a table is one question: the label that
answers it, the rows that are used, the paper's lines. Where the data are not the paper's, ``differs``
says so. A further table is a further ``TableSpec`` in ``TABLES``; paper_comparison.py makes them.
"""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool

from derender.evaluation.feature_rows import attribute_columns
from derender.evaluation.score_table import Column, Row, ScoreTable
from derender.features import FeatureTable

ATTRIBUTES = "attributes"


@dataclass(frozen=True)
class PaperRow:
    """One line of the paper: method and data set as it names them, scores (0..1) by our columns."""

    method: str
    dataset: str
    scores: Mapping[str, float]


def _lines(part: str) -> tuple[PaperRow, ...]:
    """The paper's lines of a part, in its order."""
    text = (files("derender.evaluation") / "paper_tables.csv").read_text(encoding="utf-8")
    lines = [line for line in csv.DictReader(text.splitlines()) if line.pop("part") == part]
    about = [(line.pop("method"), line.pop("dataset")) for line in lines]
    scores = [{name: float(value) for name, value in line.items() if value} for line in lines]
    return tuple(PaperRow(*names, own) for names, own in zip(about, scores, strict=True))


@dataclass(frozen=True)
class Part:
    """One question of a table: its name, the paper's lines, and what the paper used, in words.

    The first of ``labels`` that is present answers it; ``attributes`` stands for every yes/no column.
    ``layout`` is the paper's own data, all others stand in; ``size`` rows of each class are used.
    """

    name: str
    labels: tuple[str, ...]
    paper: tuple[PaperRow, ...]
    layout: str
    in_the_paper: str
    size: int | None = None

    def columns(self, table: FeatureTable) -> tuple[str, ...]:
        """The label columns of a table that answer the question; empty if it has none."""
        if self.labels == (ATTRIBUTES,):
            return attribute_columns(table.labels)
        return next(((name,) for name in self.labels if name in table.labels), ())

    def rows(self, table: FeatureTable) -> dict[str, Any]:
        """Which rows of a table are asked, as ``prepare`` takes it: the mean over each track of a person."""
        if self.name == "identity" and "track" in table.labels:
            return {"mean_by": (*self.columns(table), "track")}
        return {} if self.size is None else {"min_count": self.size, "max_count": self.size}

    def left_out(self, table: FeatureTable) -> Bool[np.ndarray, " n"]:
        """The rows that are none of the paper's: background people of tracks, sports cars but Ferraris."""
        if self.name == "identity" and "track" in table.labels:
            return np.char.startswith(table.label(self.columns(table)[0]).astype(str), "unknown_")
        if self.name == "cars" and {"name", "class"} <= table.labels.keys():
            names = np.char.lower(table.label("name").astype(str))
            return (table.label("class") == "sports") & (np.char.find(names, "ferrari") < 0)
        return np.zeros(len(table), bool)

    def differs(self, layout: str, n_rows: int, rows: str = "rows") -> str:
        """What to know before comparing a result on these data with the paper's."""
        own = f"{n_rows:,} {rows} of {layout}"
        if layout == self.layout:
            return f"subset: {own}; the paper: {self.in_the_paper}"
        return f"stand-in: {own} for {self.in_the_paper}"


IDENTITY = Part(
    "identity", ("identity",), _lines("identity"), "face_tracks",
    "644 tracks of 5 people (BBT) and 568 of 6 (Buffy)", size=20,
)  # fmt: skip
EMOTION = Part(
    "emotion", ("emotion", "expression"), _lines("emotion"), "rafdb", "3,068 images of RAF-DB, 7 emotions"
)
FACE_ATTRIBUTES = Part(
    ATTRIBUTES, (ATTRIBUTES,), _lines(ATTRIBUTES), "celeba", "6,000 images of CelebA, mean of 40 attributes"
)
CARS = Part("cars", ("class",), _lines("cars"), "shapenet_cars", "1,000 images of ShapeNet cars, 5 classes")
LINEAR = Part(ATTRIBUTES, (ATTRIBUTES,), _lines("linear"), "celeba", "6,000 images of CelebA, 40 attributes")
SEGMENTATION = Part(
    "segmentation", ("mask",), _lines("segmentation"), "celebamask",
    "24,127 + 2,885 images of CelebAMask-HQ at 64 x 64, 19 classes",
)  # fmt: skip


@dataclass(frozen=True)
class TableSpec:
    """One of the paper's tables, or a part: its number there, the protocol that makes it, its questions."""

    number: int
    kind: Literal["cluster", "linear", "segment"]
    parts: tuple[Part, ...]


TABLES = {  # by name on the command line, in the order of the paper's: parts of one come after the whole
    "clustering": TableSpec(1, "cluster", (IDENTITY, EMOTION, FACE_ATTRIBUTES)),
    "identity": TableSpec(1, "cluster", (IDENTITY,)),
    "emotion": TableSpec(1, "cluster", (EMOTION,)),
    "linear": TableSpec(2, "linear", (LINEAR,)),
    "segmentation": TableSpec(3, "segment", (SEGMENTATION,)),
    "cars": TableSpec(4, "cluster", (CARS,)),
}


def beside_the_paper(
    ours: ScoreTable, scores: Sequence[str], paper: Sequence[PaperRow], differs: str
) -> ScoreTable:
    """Our rows over the paper's lines, whose ``scores`` are in the order of our columns; the last column is
    the data, or how ours differ."""
    rows = [replace(row, cells=(*row.cells, differs)) for row in ours.rows]
    for line in paper:
        cells = (*map(line.scores.get, scores), line.dataset)
        rows.append(Row(f"paper: {line.method}", cells, note="paper"))
    return replace(ours, columns=(*ours.columns, Column("data")), rows=rows)
