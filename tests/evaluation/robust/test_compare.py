"""Curves and areas: the truth scores 1, the light itself scores chance, worse features have lower areas."""

from dataclasses import replace

import numpy as np
import pytest

from derender.evaluation.linear_task import task_of
from derender.evaluation.robust import area_under, compare_robustness
from derender.evaluation.trials import Curve, Trial

PEOPLE, EACH = 4, 10
LEVELS = (0.0, 30.0, 60.0)
SEEDS = (0, 1, 2, 3, 4)


def stack(levels: tuple[float, ...] = LEVELS) -> tuple[Trial, np.ndarray, np.ndarray]:
    """A trial of four people: learned from, tested, tested at every angle; who and which angle."""
    who = np.tile(np.arange(PEOPLE), EACH * (2 + len(levels)))
    part = len(who) // (2 + len(levels))
    rows = [np.arange(at * part, (at + 1) * part) for at in range(2 + len(levels))]
    angle = np.concatenate([np.zeros(2 * part), *(np.full(part, level) for level in levels)])
    unit = np.concatenate([np.arange(part), *[part + np.arange(part)] * (1 + len(levels))])
    curve = Curve("light", "light", rows[0], levels, tuple(rows[1:]))
    task = task_of({"identity": np.array(list("abcd"))[who]})
    images = np.zeros((len(who), 3, 2, 2), np.uint8)
    return Trial(images, task, unit, (curve,), "made up"), who, angle


def rows_of(result, score: str = "accuracy") -> dict:
    return {row.name: row for row in result.curves[0].rows[score]}


def test_identity_itself_scores_one_and_the_light_itself_chance():
    trial, who, angle = stack()
    truth = np.eye(PEOPLE)[who]
    learned = np.arange(len(who)) < PEOPLE * EACH
    # whoever was learned from stood in a light of his own; then all stand in the same
    light = np.column_stack((np.where(learned, who * 10.0, angle), np.ones(len(who))))
    features = {"truth": [truth], "light": [light]}
    result = compare_robustness(features, trial, SEEDS, controls=["light"], resample_count=50)
    rows = rows_of(result)
    assert rows["truth"].scores["area"].value == 1 and rows["truth"].scores["ordinary"].value == 1
    assert rows["truth"].versus["area"].above and rows["truth"].versus["area"].value == 0.75
    for level in LEVELS:
        assert rows["light"].scores[f"{level:g} deg"].value == 1 / PEOPLE  # one answer for all of them
    assert rows["light"].scores["area"].value == rows["majority"].scores["area"].value == 1 / PEOPLE
    assert rows_of(result, "balanced_accuracy")["majority"].scores["area"].value == 1 / PEOPLE
    assert result.curves[0].n_tested == (40, 40, 40, 40) and result.n_learned == {"light": 32}


def test_the_area_is_the_known_one():
    assert area_under((0, 30, 60), np.array([1, 0.5, 0])) == pytest.approx(0.5)
    assert area_under((0, 10, 40), np.array([1, 1, 0])) == pytest.approx(0.625)  # wide steps count for more
    assert area_under((5, 10), np.array([[0.3, 0.3], [0, 1]])) == pytest.approx([0.3, 0.5])
    with pytest.raises(ValueError, match="two growing levels"):
        area_under((0, 0), np.ones(2))


def test_nothing_that_is_tested_is_learned():
    """Features that are right on what is learned from, and noise elsewhere, score chance."""
    trial, who, _ = stack()
    noise = np.random.default_rng(1).normal(size=(len(who), PEOPLE))
    noise[: PEOPLE * EACH] = 5 * np.eye(PEOPLE)[who[: PEOPLE * EACH]]
    result = compare_robustness({"noise": [noise]}, trial, (0,), resample_count=20)
    assert rows_of(result)["noise"].scores["area"].value < 0.5
    with pytest.raises(ValueError, match="40 units would be both learned from and tested"):
        Trial(trial.images, trial.task, trial.unit % 40, trial.curves, "made up")


def test_bad_features_are_refused():
    trial, who, _ = stack()
    with pytest.raises(ValueError, match="'short' have 3 rows, the labels 200"):
        compare_robustness({"short": [np.ones((3, 2))]}, trial, SEEDS)
    with pytest.raises(ValueError, match="and a seed"):
        compare_robustness({"f": [np.eye(PEOPLE)[who]]}, trial, ())
    with pytest.raises(ValueError, match="not finite"):
        compare_robustness({"f": [np.full((len(who), 2), np.nan)]}, trial, SEEDS)
    curve = trial.curves[0]
    few = replace(curve, learn=curve.learn[:4])
    with pytest.raises(ValueError, match="light: 4 rows to learn from"):
        Trial(trial.images, trial.task, trial.unit, (few,), "made up")


def test_what_fades_with_the_angle_has_the_smaller_area():
    trial, who, angle = stack()
    noise = np.random.default_rng(0).normal(size=(len(who), PEOPLE))
    fading = angle[:, None] / 60 * noise[trial.unit]  # a face fades in its own way
    faded = {f"{strength}": [np.eye(PEOPLE)[who] + strength * fading] for strength in (0.0, 0.6, 3.0)}
    result = compare_robustness(faded, trial, (0,), resample_count=20)
    rows, curve = rows_of(result), result.curves[0]
    areas = [rows[name].scores["area"].value for name in ("0.0", "0.6", "3.0", "majority")]
    assert areas == sorted(areas, reverse=True) and areas[0] == 1 and len(set(areas)) == 4
    shares = curve.values(rows["3.0"])
    assert shares == sorted(shares, reverse=True) and shares[0] == 1
    assert rows["3.0"].scores["area"].value == pytest.approx(float(area_under(LEVELS, np.array(shares))))
