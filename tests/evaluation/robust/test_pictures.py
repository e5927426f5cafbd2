"""Where trials come from: the generator, a model that re-renders, and true angles of a rendered set."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from derender import Derenderer
from derender.data import ImageSet
from derender.evaluation import trials
from derender.evaluation.linear_task import task_of
from derender.evaluation.memory import Memory
from derender.evaluation.trials import Recipe, chosen_axes
from derender.render import render_scene

YAW, LIGHT = chosen_axes(["yaw", "light"])


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
    trial = trials.generated_trial(recipe, (YAW, LIGHT), (0, 30), memory=Memory(tmp_path))
    yaw, light = trial.curves
    assert len(trial.images) == 9 + 6 + 2 * (6 + 12)  # 30 degrees to either side
    assert [len(rows) for rows in (*yaw.points, *light.points[1:])] == [6, 6, 12, 6, 12]
    memory = Memory(tmp_path)
    again = trials.generated_trial(replace(recipe), (YAW, LIGHT), (0, 30), memory=memory)
    assert memory.recalled == 1 and np.array_equal(again.images, trial.images)
    expected = recipe.generate("tested", axis=LIGHT, angle=30.0)
    assert np.array_equal(trial.images[light.points[2][6:]], expected.images)
    assert trial.task.targets[light.points[2][6:]].argmax(1).tolist() == (
        np.unique(expected.identity.astype(str), return_inverse=True)[1].tolist()
    )
    assert trial.unit[light.points[2]].tolist() == 2 * trial.unit[yaw.points[0]].tolist()


def test_nobody_is_asked_what_nobody_could_learn():
    recipe = Recipe("cars", "class", people=16, learned=1, tested=1, image_size=16)
    trial = trials.generated_trial(recipe, [LIGHT], (0, 20))
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
    trial = trials.rendered_trial(model, pictures, task, learn, test, (YAW, LIGHT), (0, 40))
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
    apart = trials.rendered_trial(model, pictures, task, learn, test, (YAW,), (0, 40), groups=groups)
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
        trials.generated_trial(replace(few, label="expresion"), [YAW], (0, 9))
    with pytest.raises(ValueError, match="fewer than two values of 'identity' have two images"):
        trials.generated_trial(few, [YAW], (0, 9))
