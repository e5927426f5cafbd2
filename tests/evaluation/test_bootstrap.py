"""Intervals against closed forms; paired differences; the strongest control."""

import numpy as np
import pytest

from derender.evaluation import bootstrap
from derender.evaluation.bootstrap import ScoredRow, constant, difference, estimate, resamples, with_verdicts


def all_weights(n_rows: int, count: int, seed: int = 0) -> np.ndarray:
    return np.concatenate(list(resamples(n_rows, count, seed)))


def row(name: str, values: np.ndarray, weights: np.ndarray, control: bool = False) -> ScoredRow:
    mean = weights @ values / len(values)
    return ScoredRow(name, control, 1, {"accuracy": estimate([values.mean()], mean)})


def test_a_resample_draws_as_many_rows_and_portions_do_not_matter(monkeypatch):
    weights = all_weights(50, 300)
    assert weights.shape == (300, 50) and (weights.sum(axis=1) == 50).all()
    assert weights.mean(axis=0) == pytest.approx(1, abs=0.3) and weights.var() == pytest.approx(1, abs=0.1)
    monkeypatch.setattr("derender.evaluation.bootstrap.CHUNK_BYTES", 8 * 50 * 7)
    parts = list(resamples(50, 300))
    assert len(parts) == 43 and np.array_equal(np.concatenate(parts), weights)


def test_the_interval_of_a_share_is_the_known_one():
    right = np.arange(400) < 300
    result = estimate([0.75], all_weights(400, 4_000) @ right / 400)
    error = 1.96 * (0.75 * 0.25 / 400) ** 0.5
    assert result.low == pytest.approx(0.75 - error, abs=0.004)
    assert result.high == pytest.approx(0.75 + error, abs=0.004)
    assert np.isnan(result.deviation)
    assert estimate([0.7, 0.8], np.zeros(3)).deviation == pytest.approx(0.1 / 2**0.5)


def test_centred_resamples_lie_about_the_value():
    result = estimate([0.5], np.array([0.6, 0.7, 0.8]), centred=True)
    assert (result.low + result.high) / 2 == pytest.approx(0.5) and result.low < 0.5 < result.high
    assert estimate([0.95], np.array([0.6, 0.7, 0.8]), centred=True, most=1.0).high == pytest.approx(0.9975)
    assert estimate([0.99], np.array([0.1, 0.7, 0.8, 0.9]), centred=True, most=1.0).high == 1


def test_paired_differences_see_what_separate_intervals_do_not():
    rng, weights = np.random.default_rng(0), all_weights(1_000, 1_000)
    control = (rng.random(1_000) < 0.6).astype(float)
    ours = control.copy()
    ours[np.flatnonzero(control == 0)[:20]] = 1
    mine, theirs = row("ours", ours, weights), row("pca", control, weights, True)
    assert mine.scores["accuracy"].low < theirs.scores["accuracy"].high
    judged = with_verdicts([mine, theirs])
    verdict = judged[0].versus["accuracy"]
    assert verdict.above and verdict.value == pytest.approx(0.02) and verdict.rival == "pca"
    assert not judged[1].versus
    same = difference(mine.scores["accuracy"], {"twin": mine.scores["accuracy"]})
    assert (same.low, same.high, same.above) == (0, 0, False)


def test_the_strongest_control_is_the_one_to_beat():
    rows = [ScoredRow("ours", False, 1, {"nmi": estimate([0.5], np.full(10, 0.5))})]
    rows += [ScoredRow(name, True, 1, {"nmi": constant(by, 10)}) for name, by in (("a", 0.4), ("b", 0.6))]
    verdict = with_verdicts(rows)[0].versus["nmi"]
    assert verdict.rival == "b" and verdict.value == pytest.approx(-0.1) and not verdict.above
    assert with_verdicts(rows[:1])[0].versus == {}
    unsure = difference(constant(0.9, 10), {"a": constant(0.4, 10)})
    assert unsure.value == pytest.approx(0.5) and np.isnan(unsure.low) and not unsure.above
    with pytest.raises(ValueError, match="no control to compare with"):
        difference(constant(0.5), {})


def test_features_of_equal_worth_are_called_better_by_chance_alone():
    """Of many pairs that do not differ, about one in forty has its whole 95 % interval above 0."""
    rng, weights, above = np.random.default_rng(3), all_weights(200, 400), 0
    for _ in range(200):
        pair = (rng.random((2, 200)) < 0.7).astype(float)
        judged = with_verdicts([row("ours", pair[0], weights), row("control", pair[1], weights, True)])
        above += judged[0].versus["accuracy"].above
    assert 0 <= above <= 14


def test_numbers_carry_no_resamples_which_need_rows():
    result = bootstrap.numbers_of([row("ours", np.ones(5), all_weights(5, 4))])["ours"]["scores"]["accuracy"]
    assert result == pytest.approx({"value": 1, "low": 1, "high": 1, "spread": np.nan}, nan_ok=True)
    with pytest.raises(ValueError, match="needs a row and a resample, got 0 rows"):
        list(resamples(0))
