"""The table of joint training: a fine-tuned model beside heads on frozen features and the majority."""

from derender.evaluation.finetuning import FinetuneScores
from derender.evaluation.linear_probing import LINEAR_COLUMNS
from derender.evaluation.score_table import ScoreTable, scored_table


def finetuning_table(found: FinetuneScores, began: str) -> ScoreTable:
    """A row each; ``began`` names what the features of the frozen heads are from."""
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
    both = ("accuracy", "balanced_accuracy")
    return scored_table(
        caption, "trained on labels", found.rows, LINEAR_COLUMNS, intervals=both, deviations=()
    )
