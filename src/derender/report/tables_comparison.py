"""Tables from comparisons of features: scores with intervals, who beats the controls, and beside the paper.

Leaves out computing (``derender.evaluation``) and showing (cli/console.py, table_text.py, blocks.py).
"""

from collections.abc import Mapping, Sequence
from math import isfinite

from derender.evaluation.bootstrap import ScoredRow
from derender.evaluation.clustering_compare import ClusterComparison
from derender.evaluation.clustering_levels import Level
from derender.evaluation.linear_compare import LinearComparison, LinearPart
from derender.evaluation.tables import PaperRow
from derender.report.score_table import Cell, Column, Row, ScoreTable

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
INTERVAL = Column("95 %", note="interval of the first score over resamples of the scored rows")
SPREAD = Column("±", note="standard deviation of the first score over seeds")
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
    return _scores_table(caption, comparison.rows, CLUSTER_COLUMNS)


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
    return _scores_table(caption, part.rows, LINEAR_COLUMNS)


def linear_tables(comparison: LinearComparison) -> list[ScoreTable]:
    """Every head at every number of labels, each with its verdicts."""
    tables = []
    for part in comparison.parts:
        caption = f"{part.count:,} labelled rows, {part.head}: above the strongest control?"
        tables += [linear_part_table(comparison, part), verdict_table(part.rows, LINEAR_COLUMNS, caption)]
    return tables


def verdict_table(rows: Sequence[ScoredRow], columns: Mapping[str, Column], caption: str) -> ScoreTable:
    """Which row is above the strongest control, in each score named by a column, and by how much."""
    found = [
        Row(
            f"{row.name}: {columns[name].name}",
            (one.value, one.low, one.high, one.rival, "yes" if one.above else "no"),
        )
        for row in rows
        for name, one in row.versus.items()
        if name in columns and isfinite(row.scores[name].low)
    ]
    shown = (
        Column("difference", None, note="to the strongest control, on the same resamples"),
        Column("low"),
        Column("high"),
        Column("strongest control"),
        Column("above", note="whether the whole 95 % interval lies above 0"),
    )
    return ScoreTable(caption, "features: score", shown, found)


def verdict(row: ScoredRow, score: str) -> str:
    """In words: whether a row is above the strongest control in one score."""
    own, one = row.scores[score], row.versus.get(score)
    if one is None:
        return f"{row.name}: {own.value:.3f} ({score})"
    found = "above" if one.above else "below" if one.high < 0 else "not told apart from"
    return (
        f"{row.name}: {score} {own.value:.3f}, {found} the strongest control ({one.rival}): "
        f"{one.value:+.3f}, 95 % {one.low:+.3f} to {one.high:+.3f}"
    )


def paper_cluster_table(
    name: str, number: int, paper: Sequence[PaperRow], comparison: ClusterComparison, differs: str
) -> ScoreTable:
    """Our rows over the paper's own lines, with a column that says what differs."""
    columns = (*(CLUSTER_COLUMNS[one] for one in ("accuracy", "f1")), INTERVAL, Column("data"))
    ours = [
        Row(
            row.name,
            (*_values(row, ("accuracy", "f1")), interval_text(row, "accuracy"), differs),
            row.control,
        )
        for row in comparison.rows
    ]
    theirs = [
        Row(
            f"paper: {row.method}",
            (row.scores["accuracy"], row.scores["f1"], None, row.dataset),
            note="paper",
        )
        for row in paper
    ]
    caption = f"{name}, beside the paper's Table {number} ({_method(comparison.method)})"
    return ScoreTable(caption, "features", columns, (*ours, *theirs))


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


def _scores_table(caption: str, rows: Sequence[ScoredRow], columns: Mapping[str, Column]) -> ScoreTable:
    first, *others = columns
    shown = (columns[first], INTERVAL, SPREAD, *(columns[name] for name in others))
    cells = [
        Row(
            row.name,
            (
                row.scores[first].value,
                interval_text(row, first),
                spread_value(row, first),
                *_values(row, others),
            ),
            row.control,
        )
        for row in rows
    ]
    return ScoreTable(caption, "features", shown, cells)


def _values(row: ScoredRow, names: Sequence[str]) -> list[Cell]:
    return [row.scores[name].value for name in names]


def spread_value(row: ScoredRow, name: str) -> Cell:
    """The standard deviation over seeds of one score, None for a single run."""
    spread = row.scores[name].spread
    return spread if isfinite(spread) else None


def interval_text(row: ScoredRow, name: str) -> Cell:
    """The interval of one score, None where there is none."""
    one = row.scores[name]
    return f"{one.low:.3f}-{one.high:.3f}" if isfinite(one.low) else None


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
