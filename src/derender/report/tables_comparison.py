"""Tables from comparisons of features: scores with intervals, who beats the controls, and beside the paper.

Leaves out computing (``derender.evaluation``) and showing (cli/console.py, blocks.py).
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

from derender.evaluation.bootstrap import ScoredRow
from derender.evaluation.clustering_compare import ClusterComparison
from derender.evaluation.clustering_levels import Level
from derender.evaluation.linear_compare import LinearComparison, LinearPart
from derender.evaluation.score_table import (
    Cell,
    Column,
    Row,
    ScoreTable,
    interval_column,
    interval_of,
    scored_table,
    verdict_table,
)
from derender.evaluation.tables import PaperRow

CLUSTER_COLUMNS = {
    "accuracy": Column("accuracy", "high", note="weighted purity, 0 to 1"),
    "f1": Column("F1", "high", note="weighted F1 of majority labels, 0 to 1"),
    "nmi": Column("NMI", "high", note="normalised mutual information, 0 to 1"),
    "hungarian": Column("matched", "high", note="share of rows under the best one-to-one matching, 0 to 1"),
    "ari": Column("ARI", "high", note="adjusted Rand index, 0 for random clusters, at most 1"),
}
LINEAR_COLUMNS = {
    "accuracy": Column("accuracy", "high", note="share of right answers at threshold 0.5, 0 to 1"),
    "balanced_accuracy": Column("balanced", "high", note="mean recall over values or classes, 0 to 1"),
    "average_precision": Column("AP", "high", note="average precision, 0 to 1"),
}
PROBES = {
    "linear": "the paper's head, frozen features",
    "centred": "the paper's head, frozen features, centred",
    "logistic": "penalised logistic regression",
    "k-NN": "10 nearest neighbours",
    "fine-tuned": "the paper's head, encoders trained too",
}


def cluster_comparison_table(comparison: ClusterComparison) -> ScoreTable:
    """One row for each feature and control, all five scores."""
    labels = comparison.labels
    what = (
        f"{next(iter(labels.values()))} classes of {next(iter(labels))}"
        if len(labels) == 1
        else f"mean of {len(labels)} labels"
    )
    caption = f"{_method(comparison.method)}: {comparison.n_rows:,} rows, {what}"
    if comparison.n_dropped:
        caption += f"; {comparison.n_dropped:,} rows without label left out"
    if comparison.n_missing:
        caption += f"; {comparison.n_missing:,} single labels unknown"
    return scored_table(caption, "features", comparison.rows, CLUSTER_COLUMNS)


def linear_part_table(comparison: LinearComparison, part: LinearPart) -> ScoreTable:
    """One head at one number of labels: a row for each feature and control."""
    what = (
        f"{len(comparison.names)} classes"
        if comparison.kind == "classes"
        else f"mean of {len(comparison.names)} yes/no labels"
    )
    caption = (
        f"{part.count:,} labelled rows, {PROBES.get(part.head, part.head)}: {comparison.n_test:,} rows "
        f"tested, {what}, {len(comparison.seeds)} seeds"
    )
    if comparison.n_dropped:
        caption += f"; {comparison.n_dropped:,} rows without label left out"
    return scored_table(caption, "features", part.rows, LINEAR_COLUMNS)


def linear_tables(comparison: LinearComparison) -> list[ScoreTable]:
    """Every head at every number of labels, each with its verdicts."""
    tables = []
    for part in comparison.parts:
        caption = f"{part.count:,} labelled rows, {part.head}: above the strongest control?"
        tables += [linear_part_table(comparison, part), verdict_table(part.rows, LINEAR_COLUMNS, caption)]
    return tables


def paper_cluster_table(
    name: str, number: int, paper: Sequence[PaperRow], comparison: ClusterComparison, differs: str
) -> ScoreTable:
    """Our rows over the paper's own lines, with a column that says what differs."""
    columns = {one: CLUSTER_COLUMNS[one] for one in ("accuracy", "f1")}
    more: dict[Column, Callable[[ScoredRow], Cell]] = {
        interval_column(CLUSTER_COLUMNS["accuracy"]): lambda row: interval_of(row, "accuracy"),
        Column("data"): lambda _: differs,
    }
    caption = f"{name}, beside the paper's Table {number} ({_method(comparison.method)})"
    ours = scored_table(caption, "features", comparison.rows, columns, intervals=(), deviations=(), more=more)
    theirs = [
        Row(f"paper: {row.method}", (*(row.scores[one] for one in columns), None, row.dataset), note="paper")
        for row in paper
    ]
    return replace(ours, rows=[*ours.rows, *theirs])


def paper_linear_table(
    name: str, number: int, paper: Sequence[PaperRow], comparison: LinearComparison, differs: str
) -> ScoreTable:
    """Accuracies of the paper's head by number of labels, frozen and fine-tuned, over the paper's own."""
    shown = [part for part in comparison.parts if part.head in ("linear", "fine-tuned")]
    keys = [f"{part.head} {part.count}" for part in shown]
    columns = [
        Column(f"{part.count:,} {'frozen' if part.head == 'linear' else part.head}", "high") for part in shown
    ]
    scored: dict[str, dict[str, Cell]] = {}
    controls = {}
    for key, part in zip(keys, shown, strict=True):
        for row in part.rows:
            scored.setdefault(row.name, {})[key] = row.scores["accuracy"].value
            controls[row.name] = row.control
    ours = [
        Row(row, (*(values.get(key) for key in keys), differs), controls[row])
        for row, values in scored.items()
    ]
    lines: dict[str, dict[str, float]] = {}
    for row in paper:
        lines.setdefault(row.method, {}).update(row.scores)
    theirs = [
        Row(f"paper: {method}", (*(values.get(key) for key in keys), paper[0].dataset), note="paper")
        for method, values in lines.items()
        if any(key in values for key in keys)
    ]
    caption = f"{name}: accuracy of the paper's head, beside the paper's Table {number}"
    return ScoreTable(caption, "features", (*columns, Column("data")), (*ours, *theirs))


def _method(method: str) -> str:
    return {"ward": "Ward clustering", "finch": "FINCH clustering", "k-means": "k-means"}.get(method, method)


def finch_table(name: str, levels: Sequence[Level], classes: int) -> ScoreTable:
    """FINCH's partitions from fine to coarse, each accuracy beside its own chance level."""
    columns = (
        Column("accuracy", None, note="weighted purity, 0 to 1; grows with the number of clusters"),
        Column("by chance", None, note="accuracy of the same cluster sizes, rows dealt at random"),
        *(CLUSTER_COLUMNS[one] for one in ("nmi", "ari")),
    )
    rows = [
        Row(
            f"{level.clusters:,} clusters",
            (level.scores.accuracy, level.chance.accuracy, level.scores.nmi, level.scores.ari),
        )
        for level in levels
    ]
    return ScoreTable(f"FINCH on {name}: partitions found, {classes} classes", "partition", columns, rows)
