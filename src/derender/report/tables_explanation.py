"""Tables of an explanation: shares by factor, what the answer loses without one, maps checked, groups."""

from collections.abc import Sequence

import numpy as np

from derender.evaluation.score_table import Cell, Column, Interval, Row, ScoreTable, interval_column
from derender.interpretation import ClusterShares, Explanation, PairParts, ShareRow
from derender.interpretation.sanity import UNCHANGED, Similarity

AUC = Column("AUC", note="area under the ROC curve on held-out pictures, chance 0.5, best 1")


def share_table(found: Explanation) -> ScoreTable:
    """One row for each label or class, their mean first; the means of the controls last."""
    columns: list[Column] = []
    for factor in found.factors:
        column = Column(factor, note="share of the sum of |integrated gradients|, 0 to 1")
        columns += [column, interval_column(column, "pictures")]
    model, *controls = found.rows
    rows = [_mean_row(f"mean of {len(found.names)}", model)] if len(found.names) > 1 else []
    for answer, name in enumerate(found.names):
        cells: list[Cell] = []
        for place in range(len(found.factors)):
            ends = model.low[answer, place], model.high[answer, place]
            cells += [_number(model.shares[:, answer, place]), Interval(*map(float, ends))]
        rows.append(Row(name, (*cells, _number(model.auc[:, answer]))))
    rows += [_mean_row(row.name, row) for row in controls]
    what = "yes/no labels" if found.kind == "labels" else "classes, each on its own pictures"
    seeds = len(model.shares)
    caption = (
        f"Share of each factor in the answer: {found.head} probe of {found.n_train:,} pictures, "
        f"{found.n_test:,} held out, {seeds} seed{'s' if seeds > 1 else ''}, {len(found.names)} {what}; "
        f"{found.output} from a {found.baseline} baseline, completeness error {model.error:.1e}"
    )
    return ScoreTable(caption, "label" if found.kind == "labels" else "class", (*columns, AUC), rows)


def drop_table(found: Explanation) -> ScoreTable:
    """AUC lost when one factor's features are dealt at random among the held-out pictures."""
    columns = tuple(Column(factor, note="AUC lost without this factor") for factor in found.factors)
    model, *controls = found.rows
    many = len(found.names) > 1
    rows = [Row(f"mean of {len(found.names)}", _over_all(model.drop))] if many else []
    for answer, name in enumerate(found.names):
        rows.append(Row(name, tuple(_number(part) for part in model.drop[:, answer].T)))
    rows += [Row(row.name, _over_all(row.drop), True) for row in controls]
    caption = "AUC lost when one factor's features are exchanged between pictures: a check without gradients"
    return ScoreTable(caption, "label" if found.kind == "labels" else "class", columns, rows)


def share_verdicts(found: Explanation) -> list[str]:
    """In words, each factor's mean share beside that of labels dealt at random, largest first."""
    shares = {row.name: np.nanmean(row.shares, axis=(0, 1)) for row in found.rows}
    own, chance = shares["model"], shares["shuffled labels"]
    drop = np.nanmean(found.rows[0].drop, axis=(0, 1))
    return [
        f"{found.factors[place]}: {100 * own[place]:.0f} % of |IG| ({100 * chance[place]:.0f} % where labels "
        f"are dealt at random); exchanged between pictures it costs {drop[place]:.3f} of the AUC"
        for place in np.argsort(-own)
    ]


def sanity_table(rows: Sequence[Similarity]) -> ScoreTable:
    """How alike maps stay when weights, labels or the picture change; first what new weights do."""
    columns = (
        Column(
            "new weights", "low", 2, f"Spearman with maps of fresh weights; {UNCHANGED} or more: not trusted"
        ),
        Column("its SSIM", "low", 2, "structural similarity of the same maps"),
        Column("random labels", "low", 2, "Spearman with maps of a probe of labels dealt at random"),
        Column("other picture", None, 2, "Spearman with the map of another picture"),
        Column("empty", None, 2, "share of comparisons left out because a map was empty"),
        Column("changes", None, note="whether new weights change the map"),
    )
    found = {(row.method, row.factor, row.changed): row for row in rows}
    lines = []
    for method, factor in dict.fromkeys((row.method, row.factor) for row in rows):
        fresh = found[method, factor, "random weights"]
        labels, other = (found.get((method, factor, name)) for name in ("shuffled labels", "another picture"))
        word = {True: "yes", False: "no", None: "-"}[fresh.trusted]
        cells: tuple[Cell, ...] = (
            fresh.spearman, fresh.ssim, labels and labels.spearman, other and other.spearman,
            fresh.empty, word,
        )  # fmt: skip
        lines.append(Row(f"{method}, {factor}", cells))
    return ScoreTable("Do maps change with what was learned? Similarity, -1 to 1", "map", columns, lines)


def untrusted(rows: Sequence[Similarity]) -> list[str]:
    """The maps that stay as they are with fresh weights."""
    return [f"{row.method}, {row.factor}" for row in rows if row.trusted is False]


def unasked(rows: Sequence[Similarity]) -> list[str]:
    """The maps that stay as they are where the probe learned labels dealt at random."""
    stuck = [row for row in rows if row.changed == "shuffled labels" and row.spearman >= UNCHANGED]
    return [f"{row.method}, {row.factor}" for row in stuck]


def cluster_share_table(found: ClusterShares) -> ScoreTable:
    """What set each cluster apart: parts of the distance, and between-variance beside chance."""
    columns: list[Column] = [Column("pictures")]
    for factor in found.factors:
        columns += [
            Column(factor, note="share of the squared distance to all other pictures' mean, 0 to 1"),
            Column(
                "ratio", note="share of this factor's variance between cluster and rest; in brackets chance"
            ),
        ]
    rows = []
    for cluster, name in enumerate(found.names):
        cells: list[Cell] = [int(found.sizes[cluster])]
        for place in range(len(found.factors)):
            ratio, chance = found.ratio[cluster, place], found.chance[cluster, place]
            cells += [float(found.share[cluster, place]), f"{ratio:.3f} ({chance:.3f})"]
        rows.append(Row(f"cluster {name}", cells))
    caption = "What set each cluster apart: parts of the squared distance, ratios of variances (by chance)"
    return ScoreTable(caption, "cluster", columns, rows)


def pair_table(found: PairParts, names: tuple[str, str]) -> ScoreTable:
    """What makes two pictures alike, by factor and in all."""
    columns = (
        Column("of the distance", note="part of the squared distance, 0 to 1"),
        Column("of the cosine", note="part of the cosine of the whole features; sums to it"),
        Column("own cosine", note="cosine of this factor alone, -1 to 1"),
        Column("alike", note="share of random pairs that lie farther apart in this factor; 1 is most alike"),
    )
    parts = zip(found.distance_share, found.cosine, found.own_cosine, found.quantile, strict=True)
    rows = [Row(factor, tuple(map(float, cells))) for factor, cells in zip(found.factors, parts, strict=True)]
    whole = Row("all", (float(found.distance_share.sum()), float(found.cosine.sum()), None, None))
    caption = f"{names[0]} and {names[1]}: most alike in {found.most_alike}, compared with other pairs"
    return ScoreTable(caption, "factor", columns, (*rows, whole))


def _mean_row(name: str, row: ShareRow) -> Row:
    cells: list[Cell] = []
    for share in _over_all(row.shares):
        cells += [share, None]
    auc = row.auc[np.isfinite(row.auc)]
    return Row(name, (*cells, float(auc.mean()) if len(auc) else None), row.control)


def _over_all(values: np.ndarray) -> tuple[Cell, ...]:
    """(S, A, F) as the mean for each factor."""
    return tuple(_number(part) for part in values.reshape(-1, values.shape[-1]).T)


def _number(values: np.ndarray) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else None
