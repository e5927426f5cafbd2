"""Means over pictures: intervals as they must be, lower is better where it is, missing pictures left out."""

import numpy as np
import pytest

from derender.evaluation.picture_scores import picture_rows

ERROR = np.random.default_rng(0).normal(1.0, 0.2, 400)


def test_lower_scores_are_better_by_what_the_control_has_more():
    rows = picture_rows(
        {"model": {"error": ERROR, "good": ERROR}, "plane": {"error": ERROR + 0.1, "good": ERROR + 0.1}},
        ["plane"],
        lower=["error"],
    )
    model, plane = rows
    one = model.scores["error"]
    half = 1.96 * ERROR.std() / 400**0.5
    assert one.value == pytest.approx(ERROR.mean())
    assert (one.low, one.high) == pytest.approx((one.value - half, one.value + half), abs=0.003)
    better, worse = model.versus["error"], model.versus["good"]
    assert better.rival == "plane" and better.above and better.low == pytest.approx(0.1, abs=1e-6)
    assert worse.value == pytest.approx(-0.1) and not worse.above and worse.high < 0
    assert plane.control and not plane.versus


def test_the_strongest_control_is_the_lowest_error():
    controls = {"far": {"e": ERROR + 3}, "near": {"e": ERROR + 1}}
    (model, *_) = picture_rows({"model": {"e": ERROR}, **controls}, list(controls), lower=["e"])
    assert model.versus["e"].rival == "near"


def test_pictures_without_a_score_are_left_out():
    holes = ERROR.copy()
    holes[::2] = np.nan
    nothing = np.full(400, np.nan)
    rows = picture_rows(
        {"model": {"e": holes, "none": nothing}, "plane": {"e": ERROR, "none": ERROR}}, ["plane"]
    )
    found = rows[0].scores["e"]
    assert found.value == pytest.approx(ERROR[1::2].mean()) and found.low < found.value < found.high
    assert np.isnan(rows[0].scores["none"].value) and not rows[0].versus["none"].above


def test_rows_must_be_of_the_same_pictures():
    with pytest.raises(ValueError, match=r"scores of the same pictures, got \[3, 400\]"):
        picture_rows({"a": {"e": ERROR}, "b": {"e": ERROR[:3]}}, ["b"])
