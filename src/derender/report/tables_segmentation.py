"""Tables of segmentation: scores beside controls and the paper's lines, and the IoU of every class."""

from collections.abc import Callable, Mapping

from derender.evaluation.bootstrap import ScoredRow
from derender.evaluation.paper_tables import SEGMENTATION
from derender.evaluation.score_table import Cell, Column, Row, ScoreTable, scored_table, verdict_table
from derender.evaluation.segmentation import SegmentationComparison

SEGMENT_COLUMNS = {
    "mean_iou": Column("mIoU", "high", note="intersection over union, mean over classes, 0 to 1"),
    "top10_iou": Column("top 10", "high", note="the same over the row's own ten best classes, 0 to 1"),
    "pixel_accuracy": Column("pixels", "high", note="share of right pixels, 0 to 1"),
}


def segmentation_tables(found: SegmentationComparison, differs: str) -> list[ScoreTable]:
    """Everything about a comparison: scores, verdicts, classes, and the paper's lines."""
    scored = [row.scored for row in found.rows]
    judged = any(row.versus for row in scored)
    return [
        segmentation_table(found),
        *([verdict_table(scored, SEGMENT_COLUMNS, "above the strongest control?")] if judged else []),
        class_table(found),
        beside_the_paper(found, differs),
    ]


def segmentation_table(found: SegmentationComparison) -> ScoreTable:
    """A row for each net and control."""
    trainable = {row.scored.name: row.trainable or None for row in found.rows}
    learn = Column("learn", note="weights that were trained")
    scored = [row.scored for row in found.rows]
    more: Mapping[Column, Callable[[ScoredRow], Cell]] = {learn: lambda row: trainable[row.name]}
    return scored_table(_caption(found), "net", scored, SEGMENT_COLUMNS, more=more)


def beside_the_paper(found: SegmentationComparison, differs: str) -> ScoreTable:
    """Our nets and controls over the paper's lines; the last column says what differs."""
    columns = (*SEGMENT_COLUMNS.values(), Column("data"))
    rows = [
        Row(
            row.scored.name,
            (*(row.scored.scores[name].value for name in SEGMENT_COLUMNS), differs),
            row.scored.control,
        )
        for row in found.rows
    ]
    rows += [
        Row(
            f"paper: {one.method}",
            (*(one.scores[name] for name in SEGMENT_COLUMNS), one.dataset),
            note="paper",
        )
        for one in SEGMENTATION.paper
    ]
    return ScoreTable("segmentation, beside the paper's Table 3", "net", columns, rows)


def class_table(found: SegmentationComparison) -> ScoreTable:
    """A row for each class, most frequent first: its share of the tested pixels and every net's IoU."""
    nets = [row for row in found.rows if row.trainable]
    columns = (
        Column("share", note="of the tested pixels"),
        *(Column(row.scored.name, None, note="IoU, 0 to 1") for row in nets),
    )
    order = sorted(range(len(found.classes)), key=lambda number: -float(found.test_share[number]))
    rows = [
        Row(
            found.classes[number],
            (float(found.test_share[number]), *(float(row.class_iou[number]) for row in nets)),
        )
        for number in order
    ]
    return ScoreTable("intersection over union of every class", "class", columns, rows)


def _caption(found: SegmentationComparison) -> str:
    seen = int((found.test_share > 0).sum())
    seeds = "1 seed" if len(found.seeds) == 1 else f"{len(found.seeds)} seeds"
    return (
        f"segmentation: {found.n_train:,} pictures learned, {found.n_test:,} tested (by {found.split}), "
        f"{seen} of {len(found.classes)} classes tested, {found.settings.epochs} epochs, {seeds}"
    )
