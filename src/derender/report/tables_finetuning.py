"""The table of joint training: a fine-tuned model beside heads on frozen features and the majority."""

from math import isfinite

from derender.evaluation.finetuning import FinetuneScores
from derender.report.score_table import Row, ScoreTable
from derender.report.tables_comparison import INTERVAL, LINEAR_COLUMNS


def finetuning_table(found: FinetuneScores, began: str) -> ScoreTable:
    """A row each; ``began`` names what the features of the frozen heads are from."""
    columns = (
        LINEAR_COLUMNS["accuracy"],
        INTERVAL,
        LINEAR_COLUMNS["balanced_accuracy"],
        INTERVAL,
        LINEAR_COLUMNS["average_precision"],
    )
    rows = []
    for row in found.rows:
        cells: list[float | str | None] = []
        for name in ("accuracy", "balanced_accuracy"):
            one = row.scores[name]
            cells += [one.value, f"{one.low:.3f}-{one.high:.3f}" if isfinite(one.low) else None]
        rows.append(Row(row.name, (*cells, row.scores["average_precision"].value), row.control))
    what = (
        f"{len(found.names)} classes"
        if found.kind == "classes"
        else f"mean of {len(found.names)} yes/no labels"
    )
    caption = (
        f"{what}: {found.n_train:,} labelled pictures learned, {found.n_test:,} held out; "
        f"frozen features of {began}"
    )
    if found.n_unlabelled:
        caption += f"; {found.n_unlabelled:,} pictures without label never asked"
    return ScoreTable(caption, "trained on labels", columns, rows)
