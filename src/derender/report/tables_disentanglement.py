"""The disentanglement card as tables: a summary with spread over seeds, swap matrices, true factors.

Leaves out computing anything (``derender.evaluation.disentanglement``) and the picture of the matrices
(``report/matrices.py``).
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from derender.evaluation.disentanglement import DisentanglementCard, FeatureScores, swap_interval
from derender.evaluation.score_table import Column, Interval, Row, ScoreTable, interval_column

Reading = Callable[[FeatureScores], float | None]

_BETWEEN: tuple[tuple[Column, Reading], ...] = (
    (
        Column("PCC image", note="Pearson between two vectors of a picture, -1 to 1, best 0"),
        lambda scores: scores.pearson.mean_per_image,
    ),
    (
        Column("PCC dim", note="mean |Pearson| of dimensions over pictures, 0 to 1, best 0"),
        lambda scores: scores.pearson.mean_per_dimension,
    ),
    (
        Column("CKA", note="linear, unbiased; about 0 for independent features, 1 for equal ones"),
        lambda scores: scores.similarity.mean_cka_unbiased,
    ),
    (
        Column("cross R2", note="variance of a feature that another tells, held out; best 0"),
        lambda scores: scores.similarity.mean_cross_r2,
    ),
    (
        Column("swap", "high", 2, "move of the exchanged feature over the others'; chance 1"),
        lambda scores: None if scores.swap is None else scores.swap.ratio,
    ),
    (
        Column("decoded", "high", 2, "the same of decoded depth, albedo, light and camera"),
        lambda scores: None if scores.swap is None else scores.swap.ratio_parameters,
    ),
)


def summary_table(card: DisentanglementCard) -> ScoreTable:
    """One row for the model and each control: correlation, similarity and the swap test, means over seeds."""
    caption = (
        f"Disentanglement: {', '.join(card.features)} of {card.n_pictures:,} pictures, mean over "
        f"{_seeds(card)} of all pairs; low correlation alone proves nothing, read it with the swap test"
    )
    table = _table(card, caption, _BETWEEN)
    swap, decoded = table.columns[4:]
    ends = [interval_column(column, "pictures") for column in (swap, decoded)]
    columns = [*table.columns[:5], ends[0], decoded, ends[1]]
    rows = []
    for row in table.rows:
        tests = [scores.swap for scores in card.rows.get(row.name, ()) if scores.swap is not None]
        both = [Interval(*ends) for ends in swap_interval(tests)] if tests else [None, None]
        rows.append(replace(row, cells=[*row.cells[:5], both[0], row.cells[5], both[1]]))
    return replace(table, columns=columns, rows=rows)


def truth_table(card: DisentanglementCard) -> ScoreTable | None:
    """DCI, MIG, SAP of whole features against the true factors; None where these are not known."""
    first = _first(card).truth
    if first is None:
        return None
    columns: list[tuple[Column, Reading]] = [
        (
            Column("D", note="a feature tells one factor, best 1"),
            _truth("by_feature", "disentanglement"),
        ),
        (
            Column("C", note="one feature tells a factor, best 1"),
            _truth("by_feature", "completeness"),
        ),
        (Column("I", "high", note="how well all features predict"), _truth("by_feature", "informativeness")),
        (Column("MIG", "high", note="mutual information gap"), _truth("by_feature", "mig")),
        (Column("SAP", "high", note="gap of predictive score"), _truth("by_feature", "sap")),
        (
            Column("placed", "high", 2, "share of factors told best by the feature they belong to"),
            lambda scores: None if scores.truth is None else scores.truth.placed,
        ),
    ]
    caption = (
        f"Whole features against {len(first.factors)} true factors, best 1, mean over {_seeds(card)}; "
        "where I is near 0, D and C are accidents"
    )
    return _table(card, caption, columns)


def dimension_table(card: DisentanglementCard) -> ScoreTable | None:
    """DCI, MIG and SAP of single dimensions, as published; None where these were not asked for."""
    first = _first(card).truth
    if first is None or first.by_dimension is None:
        return None
    columns: list[tuple[Column, Reading]] = [
        (Column("D", note="a dimension tells one factor"), _truth("by_dimension", "disentanglement")),
        (Column("C", note="one dimension tells a factor"), _truth("by_dimension", "completeness")),
        (Column("MIG", "high", note="mutual information gap"), _truth("by_dimension", "mig")),
        (Column("SAP", "high", note="gap of squared correlation"), _truth("by_dimension", "sap")),
        (Column("D, grouped", note="importances added up by feature"), _grouped(0)),
        (Column("C, grouped", note="importances added up by feature"), _grouped(1)),
    ]
    return _table(card, f"Single dimensions, as published, mean over {_seeds(card)}", columns)


def swap_tables(card: DisentanglementCard) -> list[ScoreTable]:
    """How far features, and decoded parameters, moved when one factor was exchanged; empty without a test."""
    tests = [scores.swap for scores in next(iter(card.rows.values())) if scores.swap is not None]
    if not tests:
        return []

    def mean(name: str) -> np.ndarray:
        return np.mean([getattr(test, name) for test in tests], axis=0)

    columns = [Column(name, None, 2) for name in card.features]
    ends = (
        Column("picture", None, 2, "move of the pixels"),
        Column("left", None, 2, "distance left from the exchanged feature to the donor's, best 0"),
    )
    moved = np.concatenate([mean("moved"), mean("moved_pixels")[:, None], mean("arrived")[:, None]], axis=1)
    rows = [Row(name, cells.tolist()) for name, cells in zip(card.features, moved, strict=True)]
    loss = [*mean("unexchanged").tolist(), None, None]
    rows.append(Row("nothing", loss, True, "from a picture to its own rendering"))
    features = ScoreTable(
        "Swap test, features: 1 is the distance of two pictures; best 1 for the one exchanged, 0 elsewhere",
        "exchanged",
        [*columns, *ends],
        rows,
    )
    decoded = [
        Row(name, cells.tolist()) for name, cells in zip(card.features, mean("moved_parameters"), strict=True)
    ]
    return [features, ScoreTable("Swap test, decoded parameters", "exchanged", columns, decoded)]


def factor_r2_table(card: DisentanglementCard) -> ScoreTable | None:
    """A row for each true factor: how well each feature predicts it, all together, and the controls."""
    first = _first(card).truth
    if first is None:
        return None
    names = list(card.rows)

    def mean(row: str, field: str) -> np.ndarray:
        return np.mean([getattr(s.truth, field) for s in card.rows[row] if s.truth is not None], axis=0)

    cells = [*mean(names[0], "score"), *(mean(name, "together") for name in names), first.chance]
    heads = [*card.features, "all", *(f"all, {name.split()[0]}" for name in names[1:]), "chance"]
    return ScoreTable(
        "True factors from features, held out: R2 of light and camera, accuracy of classes; best 1",
        "true factor",
        [Column(head, None, 2) for head in heads],
        [
            Row(factor, column.tolist())
            for factor, column in zip(first.factors, np.stack(cells, 1), strict=True)
        ],
    )


def _table(card: DisentanglementCard, caption: str, columns: Sequence[tuple[Column, Reading]]) -> ScoreTable:
    """A row of means for each set of features and, with several seeds, a row of spreads below it."""
    rows = []
    for place, (name, results) in enumerate(card.rows.items()):
        values = [[reading(scores) for scores in results] for _, reading in columns]
        known = [[v for v in column if v is not None] for column in values]
        rows.append(Row(name, [float(np.mean(v)) if v else None for v in known], place > 0))
        if len(results) > 1:
            spreads = [f"{np.std(v, ddof=1):.3f}" if len(v) > 1 else None for v in known]
            rows.append(Row(f"  ± {len(results)} seeds", spreads, True))
    return ScoreTable(caption, "features", [column for column, _ in columns], rows)


def _truth(group: str, name: str) -> Reading:
    """Reads one number of the scores against ground truth."""

    def read(scores: FeatureScores) -> float | None:
        found = None if scores.truth is None else getattr(scores.truth, group)
        return None if found is None else getattr(found, name)

    return read


def _grouped(place: int) -> Reading:
    """Reads disentanglement (0) or completeness (1) of the importances added up by feature."""

    def read(scores: FeatureScores) -> float | None:
        found = None if scores.truth is None else scores.truth.grouped_dci
        return None if found is None else found[place]

    return read


def _first(card: DisentanglementCard) -> FeatureScores:
    return next(iter(card.rows.values()))[0]


def _seeds(card: DisentanglementCard) -> str:
    count = len(next(iter(card.rows.values())))
    return "1 seed" if count == 1 else f"{count} seeds"
