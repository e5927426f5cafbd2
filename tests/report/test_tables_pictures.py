"""Intervals stand behind the scores they belong to, in the units of the table."""

import numpy as np

from derender.evaluation.picture_scores import picture_rows
from derender.evaluation.score_table import Column, Row, ScoreTable
from derender.report.tables_pictures import picture_verdicts, with_intervals

COLUMNS = (Column("SIDE x 100", "low"), Column("MAD", "low", 1), Column("coverage"))
SHOWN = {"SIDE x 100": ("side", 100.0), "MAD": ("mad", 1.0)}


def test_columns_cells_and_words():
    side = np.array([0.01, 0.02, 0.03])
    each = {"model": {"side": side, "mad": 1000 * side}, "plane": {"side": side * 2, "mad": 500 * side}}
    scored = picture_rows(each, ["plane"], lower=["side", "mad"])
    rows = [Row("model", (2.0, 20.0, 0.9)), Row("plane", (4.0, 10.0, 1.0), True), Row("none", (1, 2, 3))]
    table = with_intervals(ScoreTable("c", "prediction", COLUMNS, rows), scored, SHOWN)
    assert [column.name for column in table.columns] == ["SIDE x 100", "95 %", "MAD", "95 %", "coverage"]
    assert [text for text, _ in table.texts(table.rows[0])] == [
        "2.000", "1.000-3.000", "20.0", "10.0-30.0", "0.900"
    ]  # fmt: skip
    assert table.rows[2].cells == [1, None, 2, None, 3] and table.rows[1].control
    told = picture_verdicts(scored[0], SHOWN, COLUMNS)
    assert told[0].startswith("SIDE x 100: 2.000, better than the strongest control (plane), by +2.000, 95 %")
    assert (
        told[1].startswith("MAD: 20.0, worse than the strongest control (plane), by -10.0") and len(told) == 2
    )
