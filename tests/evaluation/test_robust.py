"""Trials come from the generator, a model that re-renders, and true angles; curves and their areas."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from derender import Derenderer
from derender.data import ImageSet
from derender.evaluation import trials
from derender.evaluation.linear_task import task_of
from derender.evaluation.options import Options
from derender.evaluation.robust import area_under, compare_robustness
from derender.evaluation.trials import Curve, Recipe, Trial, chosen_axes
from derender.render import render_scene

(YAW, LIGHT), FRESH = chosen_axes(["yaw", "light"]), Options(cache="none")


def test_generated_faces_stay_the_same_while_one_angle_is_held():
    recipe = Recipe(people=3, learned=3, tested=2, image_size=16)
    learned, tested = recipe.generate("learned"), recipe.generate("tested")
    assert set(learned.identity) == set(tested.identity)
    turned = recipe.generate("tested", axis=YAW, angle=-45.0)
    assert np.degrees(turned.camera[:, 1]) == pytest.approx(np.full(6, -45), abs=1e-3)
    lit = recipe.generate("tested", axis=LIGHT, angle=60.0)
    assert np.degrees(lit.light[:, 3]) == pytest.approx(np.full(6, 60), abs=1e-3)
    assert not lit.light[:, 2].any()
    for made in (turned, lit):
        assert made.identity.tolist() == tested.identity.tolist()
        assert made.labels["expression"].tolist() == tested.labels["expression"].tolist()
    assert np.array_equal(turned.light, tested.light) and np.array_equal(lit.camera, tested.camera)
    assert np.array_equal(lit.light[:, :2], tested.light[:, :2])
    apart = replace(recipe, label="age").generate("learned")
    assert not set(apart.identity) & set(tested.identity)


def test_a_generated_trial_is_made_once(tmp_path):
    recipe = Recipe(people=3, learned=3, tested=2, image_size=16)
    trial = trials.generated_trial(recipe, (YAW, LIGHT), (0, 30), Options(cache=tmp_path))
    yaw, light = trial.curves
    assert len(trial.images) == 9 + 6 + 2 * (6 + 12)  # 30 degrees to either side
    assert [len(rows) for rows in (*yaw.points, *light.points[1:])] == [6, 6, 12, 6, 12]
    how = Options(cache=tmp_path)
    again = trials.generated_trial(replace(recipe), (YAW, LIGHT), (0, 30), how)
    assert how.memory.recalled == 1 and np.array_equal(again.images, trial.images)
    expected = recipe.generate("tested", axis=LIGHT, angle=30.0)
    assert np.array_equal(trial.images[light.points[2][6:]], expected.images)
    assert trial.task.targets[light.points[2][6:]].argmax(1).tolist() == (
        np.unique(expected.identity.astype(str), return_inverse=True)[1].tolist()
    )
    assert trial.unit[light.points[2]].tolist() == 2 * trial.unit[yaw.points[0]].tolist()


def test_nobody_is_asked_what_nobody_could_learn():
    recipe = Recipe("cars", "class", people=16, learned=1, tested=1, image_size=16)
    trial = trials.generated_trial(recipe, [LIGHT], (0, 20), FRESH)
    (curve,) = trial.curves
    counted = np.bincount(trial.task.targets[curve.learn].argmax(1), minlength=len(trial.task.names))
    asked = trial.task.targets[np.concatenate(curve.points)].argmax(1)
    assert counted.min() > 1 and counted[asked].min() > 1 and trial.n_dropped > 0


def test_a_rendered_trial_changes_the_angle_alone():
    scenes = []

    def renderer(scene, fov_deg):
        scenes.append(scene)
        return render_scene(scene, fov_deg)

    settings = Derenderer.from_preset("small", image_size=32, width=4, light_width=4).settings
    model = Derenderer.seeded(settings, 0, renderer=renderer).eval()
    images = np.random.default_rng(0).integers(0, 256, (8, 3, 32, 32), dtype=np.uint8)
    pictures = ImageSet(images, tuple("abcdefgh"))
    task = task_of({"who": np.array(list("xyxyxyxy"))})
    learn, test = np.arange(6), np.array([6, 7])
    trial = trials.rendered_trial(model, pictures, task, learn, test, (YAW, LIGHT), (0, 40), FRESH)
    plain, *turned = scenes
    assert len(trial.images) == 8 + 2 * (2 + 4) and trial.curves[0].learn.tolist() == [0, 1, 2, 3, 4, 5]
    with torch.inference_mode():
        own = model.decompose(torch.from_numpy(images[test]).float() / 255)
    assert torch.allclose(plain.camera[6:], own.camera, atol=1e-6)
    for at, (column, angle) in enumerate(((1, 0), (1, -40), (1, 40))):
        assert turned[at].camera[:, column].tolist() == pytest.approx([math.radians(angle)] * 2)
        assert torch.allclose(turned[at].light, own.light)
    for at, angle in ((3, 0), (4, -40), (5, 40)):
        assert turned[at].light[:, 3].tolist() == pytest.approx([math.radians(angle)] * 2)
        assert not turned[at].light[:, 2].any()
        assert torch.allclose(turned[at].camera, own.camera)
    assert trial.task.targets[trial.curves[1].points[2]].ravel().tolist() == [0, 1, 0, 1]
    groups = np.array(["a", "a", "b", "b", "", "", "", "c"])  # the fifth is learned from, the seventh tested
    apart = trials.rendered_trial(model, pictures, task, learn, test, (YAW,), (0, 40), FRESH, groups)
    assert apart.unit[0] == apart.unit[1] != apart.unit[2] and len(set(apart.unit[:8].tolist())) == 6


def test_true_angles_divide_tracks():
    tracks, frames = 16, 2
    track = np.repeat(np.arange(tracks), frames)
    angle = np.radians(np.where(track % 2, 1, -1) * (3.0 * track + 1))
    labels = {"track": track.astype(str), "camera_y_rad": angle}
    pictures = ImageSet(np.zeros((32, 3, 4, 4), np.uint8), tuple(map(str, range(32))), labels)
    task = task_of({"who": np.array(list("ab"))[track // 2 % 2]})
    trial = trials.true_angle_trial(pictures, task, [YAW], portions=2)
    (curve,) = trial.curves
    turn = np.degrees(np.abs(angle))
    assert turn[curve.learn].max() < min(turn[rows].min() for rows in curve.points[2:])
    assert len(curve.learn) == 12 and [len(rows) for rows in curve.points[1:]] == [4, 8, 8]
    assert curve.levels[1] == pytest.approx(turn[curve.points[2]].mean())
    assert np.array_equal(*curve.points[:2])
    with pytest.raises(ValueError, match="there is no 'light_yaw_rad'"):
        trials.true_angle_trial(pictures, task, [LIGHT])
    still = ImageSet(pictures.images, pictures.files, {**labels, "camera_y_rad": np.zeros(32)})
    with pytest.raises(ValueError, match="all at one angle"):
        trials.true_angle_trial(still, task, [YAW])


def test_bad_words_are_refused():
    with pytest.raises(ValueError, match="unknown axis 'yew'; did you mean 'yaw'"):
        chosen_axes(["yew"])
    with pytest.raises(ValueError, match="generated cars cannot be rotated about the axis 'pitch'"):
        chosen_axes(["pitch"], "cars")
    with pytest.raises(ValueError, match="two or more that grow"):
        trials.checked_levels((30, 0), [YAW])
    few = Recipe(people=2, learned=1, tested=1, image_size=16)
    with pytest.raises(ValueError, match="label of generated faces 'expresion'; did you mean 'expression'"):
        trials.generated_trial(replace(few, label="expresion"), [YAW], (0, 9), FRESH)
    with pytest.raises(ValueError, match="fewer than two values of 'identity' have two images"):
        trials.generated_trial(few, [YAW], (0, 9), FRESH)


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
