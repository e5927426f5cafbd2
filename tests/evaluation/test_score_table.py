"""Tables of scores say what the numbers say, whichever way these fall."""

import re
import sys
from dataclasses import replace

import numpy as np
import pytest

from derender.evaluation.bootstrap import Estimate, ScoredRow, constant
from derender.evaluation.score_table import Column, Interval, Row, Scores, ScoreTable, scored_table


def table(ours: float, controls: dict[str, float | None], best="high") -> ScoreTable:
    rows = [Row("ours", [ours]), *(Row(name, [value], True) for name, value in controls.items())]
    return ScoreTable("", "", [Column("score", best)], rows)


TWO = {"pca": 0.5, "pixels": 0.6}
DEPTHS = {"plane": 3.0, "average": 2.0}
BEHIND = "behind the strongest control"


@pytest.mark.parametrize(
    ("ours", "controls", "best", "expected"),
    [
        (0.9, TWO, "high", "better than every control: 0.900 against 0.600 (pixels)"),
        (0.55, TWO, "high", "behind the strongest control: 0.550 against 0.600 (pixels), but ahead of pca"),
        (0.1, TWO, "high", "behind the strongest control: 0.100 against 0.600 (pixels)"),
        (0.6, TWO, "high", "level with the strongest control: 0.600 (pixels)"),
        (1.0, DEPTHS, "low", "better than every control: 1.000 against 2.000 (average)"),
        (2.5, DEPTHS, "low", f"{BEHIND}: 2.500 against 2.000 (average), but ahead of plane"),
        (0.0, {"plane": 0.5}, "low", "better than every control: 0.000 against 0.500 (plane)"),
        (0.5, {"missing": None}, "high", "ours: 0.500 (score)"),
    ],
)
def test_verdict_compares(ours, controls, best, expected):
    assert table(ours, controls, best).verdict(0) == expected


def test_verdict_leaves_out_rows_that_are_no_control():
    scores = table(0.6, TWO | {"other model": 0.9})
    rows = [*scores.rows[:-1], replace(scores.rows[-1], control=False)]
    assert replace(scores, rows=rows).verdict(0).startswith("level with the strongest control")


def test_best_ignores_what_is_no_number():
    scores = table(0.2, {"a": float("nan"), "b": None, "c": 0.3})
    assert scores.best(0) == 0.3
    assert table(0.2, {"a": None}).best(0) is None
    assert ScoreTable("", "", [Column("size")], [Row("a", [1]), Row("b", [2])]).best(0) is None


def test_rows_must_fit_the_columns():
    with pytest.raises(ValueError, match="'ours' has 2 cells for 1 columns"):
        ScoreTable("", "", [Column("a")], [Row("ours", [1, 2])])


COLUMNS = [Column("accuracy", "high", note="0 to 1"), Column("error", "low", 1)]
COLUMNS += [Column("95 %", None, 1, of="accuracy")]
ROWS = [
    Row("geometry_a & b", (0.81234, 2.0, Interval(0.8, 0.9))),
    Row("pixels | raw", (0.5, 1.0, None), control=True),
    Row("{odd} $1 #2 ~^\\", (float("nan"), 3.0, "*x*")),
]
TABLE = ScoreTable("Scores_of 50 % | all", "features", COLUMNS, ROWS)


def test_markdown_is_the_table():
    lines = TABLE.to_markdown().splitlines()
    assert lines[0] == "Scores_of 50 % | all"
    assert lines[2] == "| features | accuracy ↑ | error ↓ | 95 % |"
    assert lines[3] == "| :--- | ---: | ---: | ---: |"
    assert lines[4] == r"| geometry\_a & b | **0.812** | 2.0 | 0.8-0.9 |"
    assert lines[5] == r"| *pixels \| raw* | 0.500 | **1.0** | - |"
    assert lines[6].endswith(r"| - | 3.0 | \*x\* |")
    assert lines[8] == "accuracy: 0 to 1"
    assert Scores([TABLE, TABLE], {}).to_markdown().count("| features |") == 2


def test_latex_is_the_table():
    text = TABLE.to_latex()
    assert r"\caption{Scores\_of 50 \% | all}" in text and r"\begin{tabular}{lrrr}" in text
    assert r"features & accuracy $\uparrow$ & error $\downarrow$ & 95 \% \\" in text
    assert r"geometry\_a \& b & \textbf{0.812} & 2.0 & 0.8-0.9 \\" in text
    assert r"\textit{pixels | raw} & 0.500 & \textbf{1.0} & - \\" in text
    assert r"\{odd\} \$1 \#2 \textasciitilde{}\textasciicircum{}\textbackslash{} & - & 3.0 & *x* \\" in text
    body = re.sub(r"\\[{}]", "", text)
    assert body.count("{") == body.count("}")
    rows = [line for line in text.splitlines() if line.endswith(r"\\")]
    assert all(re.sub(r"\\&", "", line).count("&") == 3 for line in rows)


def test_a_data_frame_holds_the_numbers_and_a_line_says_what_is_missing_for_one(monkeypatch):
    frame = Scores([TABLE], {}).to_pandas()
    assert list(frame.columns) == ["accuracy", "error", "accuracy low", "accuracy high", "control"]
    assert frame.index.name == "features"
    assert frame.loc["geometry_a & b"].tolist() == [0.81234, 2.0, 0.8, 0.9, False]
    assert frame["control"].tolist() == [False, True, False] and frame["accuracy low"].isna().sum() == 2
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="pip install pandas"):
        TABLE.to_pandas()


def test_a_table_of_scored_rows_carries_interval_and_deviation():
    rows = [
        ScoredRow("ours", False, 2, {"a": Estimate(0.5, 0.4, 0.6, 0.1, np.zeros(1)), "b": constant(0.25)}),
        ScoredRow("chance", True, 1, {"a": constant(0.125), "b": constant(0.25)}),
    ]
    columns = {"a": Column("A", "high"), "b": Column("B")}
    result = scored_table("c", "features", rows, columns, more={Column("runs"): lambda row: row.runs})
    assert [column.name for column in result.columns] == ["A", "95 %", "±", "B", "runs"]
    ours, chance = ([text for text, _ in result.texts(row)] for row in result.rows)
    assert ours == ["0.500", "0.400-0.600", "0.100", "0.250", "2"]
    assert chance == ["0.125", "-", "-", "0.250", "1"]
    assert [row.control for row in result.rows] == [False, True]
