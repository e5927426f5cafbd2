"""Configuration: presets, overrides, and errors that name the nearest key."""

import re
from pathlib import Path

import pytest
import torch
import yaml

from derender.overrides import checked, settings_by_name
from derender.training.config import PRESETS, TrainConfig, resolve, to_yaml, without_removed
from derender.training.derender_task import DerenderTask


def test_every_preset_survives_yaml():
    for name, preset in PRESETS.items():
        assert preset.preset == name
        assert checked(yaml.safe_load(to_yaml(preset)), TrainConfig) == preset


def test_overrides_by_full_and_by_short_name():
    changes = ["optimiser.learning_rate=3e-4", "batch_size=16", "betas=[0.5, 0.99]", "confidence=false"]
    config = resolve("small", changes)
    assert config.optimiser.learning_rate == 3e-4
    assert config.batch_size == 16
    assert config.optimiser.betas == (0.5, 0.99)
    assert config.objective.confidence is False
    assert config.model == PRESETS["small"].model


def test_explicit_values_win_and_none_means_not_given():
    config = resolve("small", ["seed=1"], seed=2, objective__loocc="light", images=None)
    assert (config.seed, config.objective.loocc, config.images) == (2, "light", PRESETS["small"].images)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["lerning_rate=1"], "unknown setting 'lerning_rate'.*did you mean '(optimiser.)?learning_rate'"),
        (["learning_rate"], "write key=value"), (["learning_rate=fast"], "'optimiser.learning_rate'.*'fast'"),
        (["learning_rate=-1"], "'optimiser.learning_rate'.*greater than 0"),
        (["image_size=48"], "image_size must be one of 32, 64, 128, 256"),
        (["loocc=lite"], "'objective.loocc'"),
        (["batch_size=1"], "'batch_size'.*greater than or equal to 2"),
        (["betas=[1, 2"], "cannot read the value"),
        (["learning_rate=.nan"], "finite"),
    ],
)  # fmt: skip
def test_bad_overrides_are_one_clear_sentence(overrides, message):
    with pytest.raises(ValueError, match=message) as caught:
        resolve("small", overrides)
    assert "\n" not in str(caught.value)


def test_an_unknown_preset_names_the_nearest_and_an_unknown_key_in_a_file_is_refused():
    with pytest.raises(ValueError, match="did you mean 'faces'"):
        resolve("face")
    tree = yaml.safe_load(to_yaml(PRESETS["small"]))
    with pytest.raises(ValueError, match=r"unknown setting 'objective.flip_wieght'"):
        checked({**tree, "objective": {**tree["objective"], "flip_wieght": 1}}, TrainConfig)


def test_every_setting_has_a_name_that_resolves():
    for name in settings_by_name(TrainConfig().model_dump(mode="json")):
        value = TrainConfig().model_dump(mode="json")
        for part in name.split("."):
            value = value[part]
        if value is not None:
            resolve("paper", [f"{name}={yaml.safe_dump(value, default_flow_style=True).splitlines()[0]}"])


def test_the_papers_preset_begins_and_measures_as_the_paper_does():
    paper, faces = resolve("paper"), resolve("faces")
    assert (paper.geometry_start, faces.geometry_start) == (1.0, 0.1)
    assert (paper.objective.perceptual_rescaled, faces.objective.perceptual_rescaled) == (False, True)
    assert (paper.objective.loocc_joint, faces.objective.loocc_joint) == (True, False)  # Eq. 6
    size = ["image_size=32", "width=4", "light_width=4"]
    tasks = (DerenderTask(resolve("small", [*size, *more])) for more in ([], ["geometry_start=1"]))
    plain, scaled = (task.build().nets["geometry"].decoder.last.weight for task in tasks)
    torch.testing.assert_close(10 * plain, scaled)


def test_settings_on_the_page_of_deviations_exist():
    page = (Path(__file__).parents[2] / "docs" / "explanation" / "deviations.md").read_text()
    named = re.findall(r"`([a-z_.]+=[a-z0-9.-]+)`", page)
    assert "geometry_start=1" in named and resolve("faces", named).whitening.pictures == 0


@pytest.mark.parametrize("whole", ["optimiser=x", "model={}"])
def test_a_setting_of_a_group_that_was_replaced_is_refused(whole):
    inner = {"optimiser=x": "optimiser.weight_decay=1", "model={}": "model.network.width=8"}[whole]
    with pytest.raises(ValueError, match="was set as a whole before"):
        resolve("faces", [whole, inner])


def test_settings_of_earlier_versions_load_where_they_changed_nothing():
    earlier = {"reframed": 0.0, "reframe": {"nearer": 1.4}, "objective": {"loocc_after": 0.0}, "seed": 3}
    assert without_removed(earlier) == {"objective": {}, "seed": 3}
    with pytest.raises(ValueError, match=r"setting .reframed. no longer exists: it can be 0\.0, not 0\.5"):
        without_removed({"reframed": 0.5})
