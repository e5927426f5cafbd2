"""Tables of scores say what the numbers say, however these fall; images without a score are left out."""

import re
import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from derender.evaluation.bootstrap import Estimate, ScoredRow, constant, once_and_resampled
from derender.evaluation.image_scores import ImageResult, image_rows
from derender.evaluation.score_table import Column, Interval, Row, Scores, ScoreTable, scored_table, verdict


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


def test_best_ignores_what_is_no_number_and_rows_must_fit_the_columns():
    scores = table(0.2, {"a": float("nan"), "b": None, "c": 0.3})
    assert scores.best(0) == 0.3
    assert table(0.2, {"a": None}).best(0) is None
    assert ScoreTable("", "", [Column("size")], [Row("a", [1]), Row("b", [2])]).best(0) is None
    with pytest.raises(ValueError, match="'ours': 2 cells for 1 columns"):
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
    assert repr(Scores([TABLE, TABLE], {})).count("| features |") == 2


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


ERROR = np.random.default_rng(0).normal(1.0, 0.2, 400)
ONE = {"error": Column("error", "low"), "good": Column("good", "high")}
ONCE = once_and_resampled(400)


def test_lower_scores_are_better_by_the_controls_surplus():
    more = {"error": ERROR + 0.1, "good": ERROR + 0.1}
    model, plane = image_rows({"model": {"error": ERROR, "good": ERROR}, "plane": more}, ONE, ONCE)
    one = model.scores["error"]
    half = 1.96 * ERROR.std() / 400**0.5
    assert one.value == pytest.approx(ERROR.mean())
    assert (one.low, one.high) == pytest.approx((one.value - half, one.value + half), abs=0.003)
    better, worse = model.versus["error"], model.versus["good"]
    assert better.rival == "plane" and better.above and better.low == pytest.approx(0.1, abs=1e-6)
    assert worse.value == pytest.approx(-0.1) and not worse.above and worse.high < 0
    assert plane.control and not plane.versus
    errors = {name: {"error": ERROR + by} for name, by in (("m", 0), ("far", 3), ("near", 1))}
    near = image_rows(errors, ONE, ONCE)
    assert near[0].versus["error"].rival == "near"  # the strongest control has the lowest error


def test_images_without_a_score_are_left_out():
    holes, nothing = ERROR.copy(), np.full(400, np.nan)
    holes[::2] = np.nan
    rows = image_rows({"model": {"e": holes, "n": nothing}, "plane": {"e": ERROR, "n": ERROR}}, ONE, ONCE)
    result = rows[0].scores["e"]
    assert result.value == pytest.approx(ERROR[1::2].mean()) and result.low < result.value < result.high
    assert np.isnan(rows[0].scores["n"].value) and not rows[0].versus["n"].above


class Both(ImageResult):
    columns: ClassVar = {"side": Column("SIDE x 100", "low", scale=100), "mad": Column("MAD", "low", 1)}
    notes: ClassVar = {"plane": "flat"}
    caption, coverage = "{}", Column("coverage")

    def named(self):
        side = np.array([0.01, 0.02, 0.03])
        return {
            "model": SimpleNamespace(side_each=side, mad_each=1000 * side, coverage=0.9),
            "plane": SimpleNamespace(side_each=2 * side, mad_each=500 * side, coverage=1),
        }


def test_tables_are_in_the_units_of_their_columns():
    rows = Both().rows()
    drawn = [Both().rows(20, seed)[0].scores["side"].resampled.tolist() for seed in (0, 0, 1)]
    assert drawn[0] == drawn[1] != drawn[2]
    table = Both().table(rows)
    assert [column.name for column in table.columns] == ["SIDE x 100", "95 %", "MAD", "95 %", "coverage"]
    texts = [text for text, _ in table.texts(table.rows[0])]
    assert texts == ["2.000", "1.000-3.000", "20.0", "10.0-30.0", "0.900"] and table.caption == "3 images"
    assert table.rows[1].control and table.rows[1].note == "flat"
    assert Both().table().rows[1].cells == pytest.approx([4.0, 10.0, 1])
    side, mad_words = (verdict(rows[0], score, column) for score, column in Both.columns.items())
    assert "model: SIDE x 100 2.000, better than the strongest control (plane), by +2.000, 95" in side
    assert mad_words.startswith("model: MAD 20.0, worse than the strongest control (plane), by -10.0")
