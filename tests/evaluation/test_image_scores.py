"""Means over images: intervals, lower is better where it is, missing images left out; tables and verdicts."""

from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from derender.evaluation.image_scores import ImageResult, image_rows
from derender.evaluation.score_table import Column, verdict

ERROR = np.random.default_rng(0).normal(1.0, 0.2, 400)
ONE = {"error": Column("error", "low"), "good": Column("good", "high")}


def test_lower_scores_are_better_by_the_controls_surplus():
    more = {"error": ERROR + 0.1, "good": ERROR + 0.1}
    model, plane = image_rows({"model": {"error": ERROR, "good": ERROR}, "plane": more}, ONE)
    one = model.scores["error"]
    half = 1.96 * ERROR.std() / 400**0.5
    assert one.value == pytest.approx(ERROR.mean())
    assert (one.low, one.high) == pytest.approx((one.value - half, one.value + half), abs=0.003)
    better, worse = model.versus["error"], model.versus["good"]
    assert better.rival == "plane" and better.above and better.low == pytest.approx(0.1, abs=1e-6)
    assert worse.value == pytest.approx(-0.1) and not worse.above and worse.high < 0
    assert plane.control and not plane.versus
    near = image_rows({name: {"error": ERROR + by} for name, by in (("m", 0), ("far", 3), ("near", 1))}, ONE)
    assert near[0].versus["error"].rival == "near"  # the strongest control has the lowest error


def test_images_without_a_score_are_left_out():
    holes, nothing = ERROR.copy(), np.full(400, np.nan)
    holes[::2] = np.nan
    rows = image_rows({"model": {"e": holes, "n": nothing}, "plane": {"e": ERROR, "n": ERROR}}, ONE)
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
    table = Both().table(rows)
    assert [column.name for column in table.columns] == ["SIDE x 100", "95 %", "MAD", "95 %", "coverage"]
    texts = [text for text, _ in table.texts(table.rows[0])]
    assert texts == ["2.000", "1.000-3.000", "20.0", "10.0-30.0", "0.900"] and table.caption == "3 images"
    assert table.rows[1].control and table.rows[1].note == "flat"
    assert Both().table().rows[1].cells == pytest.approx([4.0, 10.0, 1])
    side, mad_words = (verdict(rows[0], score, column) for score, column in Both.columns.items())
    assert "model: SIDE x 100 2.000, better than the strongest control (plane), by +2.000, 95" in side
    assert mad_words.startswith("model: MAD 20.0, worse than the strongest control (plane), by -10.0")
