"""The paper's tables as data: its numbers, and the protocol that makes numbers to stand beside them.

Source: Klinghoffer et al., ECCV 2022, Tables 1 to 4. A table has parts, one for each question (who is
it, which emotion, ...); a part says which label answers it, how rows are chosen, and which of the paper's
rows it stands beside. Where a user's data are not the paper's, ``differs`` says so in words. A further
table is a further ``TableSpec`` in ``TABLES`` and a runner of its kind in the command.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from derender.data import suggestion
from derender.evaluation.feature_rows import attribute_columns
from derender.features import FeatureTable

ATTRIBUTES = "attributes"


@dataclass(frozen=True)
class PaperRow:
    """One line of the paper.

    Attributes:
        method, dataset: as the paper names them.
        scores: by the name of our column, 0..1.
    """

    method: str
    dataset: str
    scores: Mapping[str, float]


@dataclass(frozen=True)
class RowRules:
    """Which rows a question is asked of; see ``feature_rows.prepare``."""

    mean_by: tuple[str, ...] = ()
    min_count: int = 1
    max_count: int | None = None


@dataclass(frozen=True)
class Part:
    """One question of a table.

    Attributes:
        name: of the question.
        labels: label columns that may answer it, the first one present; ``attributes`` stands for every
            yes/no column.
        paper: the paper's lines.
        layouts: layouts that are the paper's own data; all others stand in.
        in_the_paper: what the paper used, in words.
        min_count, max_count: rows of a class that are used where the label is single.
    """

    name: str
    labels: tuple[str, ...]
    paper: tuple[PaperRow, ...]
    layouts: tuple[str, ...]
    in_the_paper: str
    min_count: int = 1
    max_count: int | None = None

    def columns(self, table: FeatureTable) -> tuple[str, ...]:
        """The label columns of a table that answer the question; empty if it has none."""
        if self.labels == (ATTRIBUTES,):
            return attribute_columns(table)
        return next(((name,) for name in self.labels if name in table.labels), ())

    def rows(self, table: FeatureTable) -> RowRules:
        """Which rows of a table are asked: the mean over each track where people have tracks."""
        if self.name == "identity" and "track" in table.labels:
            return RowRules((*self.columns(table), "track"))
        return RowRules() if self.max_count is None else RowRules((), self.min_count, self.max_count)

    def differs(self, layout: str, n_rows: int, rows: str = "rows") -> str:
        """What to know before comparing a result on these data with the paper's."""
        own = f"{n_rows:,} {rows} of {layout}"
        if layout in self.layouts:
            return f"subset: {own}; the paper: {self.in_the_paper}"
        return f"stand-in: {own} for {self.in_the_paper}"


@dataclass(frozen=True)
class TableSpec:
    """One of the paper's tables, or a part of one.

    Attributes:
        name: on the command line.
        number: in the paper.
        kind: which protocol makes it.
        parts: its questions.
    """

    name: str
    number: int
    kind: Literal["cluster", "linear", "segment"]
    parts: tuple[Part, ...] = field(default=())


def table_named(name: str) -> TableSpec:
    """One of ``TABLES``; an unknown name is an error that names the nearest."""
    if name not in TABLES:
        raise ValueError(f"unknown table {name!r}{suggestion(name, TABLES)}; there is {', '.join(TABLES)}")
    return TABLES[name]


def _clustering(dataset: str, rows: str) -> tuple[PaperRow, ...]:
    """Lines "method | accuracy | F1"."""
    cells = [[cell.strip() for cell in line.split("|")] for line in rows.strip().splitlines()]
    return tuple(
        PaperRow(method, dataset, {"accuracy": float(accuracy), "f1": float(f1)})
        for method, accuracy, f1 in cells
    )


def _linear(count: int, rows: str) -> tuple[PaperRow, ...]:
    """Lines "method | fine-tuned | frozen" of accuracies; a dash where the paper has none."""
    found = []
    for line in rows.strip().splitlines():
        method, *values = (cell.strip() for cell in line.split("|"))
        named = zip((f"fine-tuned {count}", f"linear {count}"), values, strict=True)
        scores = {name: float(value) for name, value in named if value != "-"}
        found.append(PaperRow(method, "CelebA", scores))
    return tuple(found)


_BBT = _clustering(
    "BBT",
    """
    VQ-VAE             | 0.4168 | 0.2796
    StyleGAN2          | 0.4261 | 0.3528
    RIS                | 0.4790 | 0.4346
    Ours - No LOOCC    | 0.5754 | 0.4572
    Ours - LOOCC-L     | 0.6252 | 0.6133
    Ours - LOOCC-LV    | 0.6096 | 0.5669
    """,
)
_BUFFY = _clustering(
    "Buffy",
    """
    VQ-VAE             | 0.4489 | 0.3427
    StyleGAN2          | 0.3909 | 0.2767
    RIS                | 0.3715 | 0.2837
    Ours - No LOOCC    | 0.4507 | 0.3697
    Ours - LOOCC-L     | 0.4718 | 0.4095
    Ours - LOOCC-LV    | 0.4806 | 0.4234
    """,
)
_RAF_DB = _clustering(
    "RAF-DB",
    """
    VQ-VAE             | 0.3993 | 0.2660
    StyleGAN2          | 0.3863 | 0.2153
    RIS                | 0.3862 | 0.2152
    Ours - No LOOCC    | 0.3918 | 0.2651
    Ours - LOOCC-L     | 0.4058 | 0.3014
    Ours - LOOCC-LV    | 0.396  | 0.2452
    """,
)
_CELEBA = _clustering(
    "CelebA",
    """
    VQ-VAE             | 0.8010 | 0.7420
    StyleGAN2          | 0.8042 | 0.7466
    RIS                | 0.8023 | 0.7375
    Ours - No LOOCC    | 0.8135 | 0.7607
    Ours - LOOCC-L     | 0.8143 | 0.7616
    Ours - LOOCC-LV    | 0.8139 | 0.7649
    """,
)
_CARS = _clustering(
    "ShapeNet cars",
    """
    VQ-VAE             | 0.4915 | 0.3696
    Ours - No LOOCC    | 0.5100 | 0.3877
    Ours - LOOCC-L     | 0.5270 | 0.4016
    Ours - LOOCC-LV    | 0.5485 | 0.4995
    """,
)
_LINEAR = (
    *_linear(
        100,
        """
        Supervised ResNet-18 | 0.8186 | -
        VQ-VAE               | 0.8148 | 0.8182
        StyleGAN2            | 0.7781 | 0.7688
        RIS                  | 0.8250 | 0.8208
        Ours - No LOOCC      | 0.8212 | 0.8033
        Ours - LOOCC-L       | 0.8245 | 0.8205
        Ours - LOOCC-LV      | 0.8556 | 0.8226
        """,
    ),
    *_linear(
        500,
        """
        Supervised ResNet-18 | 0.8336 | -
        VQ-VAE               | 0.8349 | 0.8354
        StyleGAN2            | 0.8125 | 0.7875
        RIS                  | 0.8550 | 0.8500
        Ours - No LOOCC      | 0.8403 | 0.8166
        Ours - LOOCC-L       | 0.8509 | 0.8219
        Ours - LOOCC-LV      | 0.8556 | 0.8226
        """,
    ),
    *_linear(
        1_000,
        """
        Supervised ResNet-18 | 0.8407 | -
        VQ-VAE               | 0.8368 | 0.8406
        StyleGAN2            | 0.8063 | 0.7937
        RIS                  | 0.8250 | 0.8400
        Ours - No LOOCC      | 0.8539 | 0.8240
        Ours - LOOCC-L       | 0.8543 | 0.8226
        Ours - LOOCC-LV      | 0.8556 | 0.8149
        """,
    ),
)
_SEGMENTATION = tuple(
    PaperRow(
        method,
        "CelebAMask-HQ, 64 x 64",
        {"mean_iou": mean, "top10_iou": top, "pixel_accuracy": accuracy},
    )
    for method, mean, top, accuracy in (
        ("Supervised (random init)", 0.3862, 0.5858, 0.8669),
        ("Geometry Encoder", 0.4066, 0.5977, 0.8715),
        ("Albedo Encoder", 0.3987, 0.5984, 0.8724),
        ("Joint Encoders", 0.4390, 0.6221, 0.8781),
        ("Joint Encoders Frozen", 0.3962, 0.5712, 0.8540),
    )
)

IDENTITY = Part(
    "identity",
    ("identity",),
    (*_BBT, *_BUFFY),
    ("face_tracks",),
    "644 tracks of 5 people (BBT) and 568 of 6 (Buffy)",
    min_count=20,
    max_count=20,
)
EMOTION = Part(
    "emotion", ("emotion", "expression"), _RAF_DB, ("rafdb",), "3,068 pictures of RAF-DB, 7 emotions"
)
FACE_ATTRIBUTES = Part(
    ATTRIBUTES, (ATTRIBUTES,), _CELEBA, ("celeba",), "6,000 pictures of CelebA, mean of 40 attributes"
)
CARS = Part("cars", ("class",), _CARS, ("shapenet_cars",), "1,000 pictures of ShapeNet cars, 5 classes")
LINEAR = Part(ATTRIBUTES, (ATTRIBUTES,), _LINEAR, ("celeba",), "6,000 pictures of CelebA, 40 attributes")
SEGMENTATION = Part(
    "segmentation",
    ("mask",),
    _SEGMENTATION,
    ("celebamask",),
    "24,127 + 2,885 pictures of CelebAMask-HQ at 64 x 64, 19 classes",
)

TABLES: dict[str, TableSpec] = {
    spec.name: spec
    for spec in (
        TableSpec("clustering", 1, "cluster", (IDENTITY, EMOTION, FACE_ATTRIBUTES)),
        TableSpec("identity", 1, "cluster", (IDENTITY,)),
        TableSpec("emotion", 1, "cluster", (EMOTION,)),
        TableSpec("linear", 2, "linear", (LINEAR,)),
        TableSpec("segmentation", 3, "segment", (SEGMENTATION,)),
        TableSpec("cars", 4, "cluster", (CARS,)),
    )
}
"""By name, in the order of the paper's tables: parts of one come after the whole."""
