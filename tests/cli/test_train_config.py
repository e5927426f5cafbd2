"""`derender train --config`: settings from a file are those of the command line, and yield to it."""

from pathlib import Path

import pytest
import yaml
from tests.cli.conftest import run

from derender.learn.plan import read_plan
from derender.training.config import PRESETS, resolve

EXAMPLES = Path(__file__).parents[2] / "examples" / "runs"
RUNS = ["rendered-faces", "faces", "cars"]


@pytest.fixture
def settings(capsys):
    """All settings that `derender train` would run with."""

    def printed(*arguments: str | Path) -> dict:
        code = run("train", "--data", "nowhere", "--out", "nowhere/run", "--dry-run", *arguments)
        result = capsys.readouterr()
        assert code == 0, result.err
        return yaml.safe_load(result.out)

    return printed


def test_a_file_says_what_set_says_and_set_comes_after(settings, tmp_path):
    file = tmp_path / "mine.yaml"
    text = "preset: small\nimages: 5000\nobjective: {loocc: light}\nmodel.ranges: {border_depth: 1.08}\n"
    file.write_text(text)
    by_hand = resolve("small", ["images=5000", "border_depth=1.08"], objective__loocc="light")
    assert settings("--config", file) == by_hand.model_dump(mode="json")
    changed = settings("--config", file, "--set", "images=70", "--loocc", "all")
    assert (changed["images"], changed["objective"]["loocc"]) == (70, "all")
    assert changed["model"]["ranges"]["border_depth"] == 1.08


def test_the_settings_of_a_run_make_the_same_run(settings, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    asked = resolve("small", ["images=4321", "learning_rate=2e-4", "split=[0.5, 0.3, 0.2]"])
    tree = {"format": 1, **asked.model_dump(mode="json")}
    (run / "config.yaml").write_text(yaml.safe_dump(tree, sort_keys=False))
    for given in (run, run / "config.yaml"):
        assert settings("--config", given) == asked.model_dump(mode="json")


@pytest.mark.parametrize(
    ("text", "more", "message"),
    [
        ("preset: small", ["--preset", "paper"], "is for small, not for paper: leave out preset"),
        ("baseline: vqvae", ["--model", "ae"], "is for vqvae, not for ae: leave out model"),
        ("[1, 2]", [], "holds no settings"),
        ("{a: ", [], "holds no settings"),
        ("images: many", [], "setting 'images'"),
        ("imagse: 5", [], "unknown setting 'imagse'"),
        ("format: 99", [], "update derender"),
        ("preset: 3", [], "preset"),
    ],
)
def test_what_is_no_settings_is_one_clear_line(tmp_path, refused, text, more, message):
    file = tmp_path / "bad.yaml"
    file.write_text(text)
    train = ("train", "--data", "nowhere", "--out", tmp_path / "run", "--config")
    assert message in refused(*train, file, *more)
    assert f"no settings in {tmp_path / 'gone'}" in refused(*train, tmp_path / "gone")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("name", RUNS)
def test_the_runs_of_the_models_that_come_along_can_be_made_again(settings, name):
    result = settings("--config", EXAMPLES / f"{name}.yaml")
    assert result["objective"]["loocc"] == "light+camera"
    asked = yaml.safe_load((EXAMPLES / f"{name}.yaml").read_text())
    assert result["preset"] == asked["preset"]
    assert result["images"] == asked.get("images", PRESETS["small-faces"].images)


@pytest.mark.parametrize("name", ["loocc", "loocc-late", "paper"])
def test_the_plans_that_ask_what_loocc_brings_can_be_read(name):
    plan = read_plan(EXAMPLES / f"{name}.yaml")
    kinds = [method.settings["loocc"] for method in plan.methods.values() if "loocc" in method.settings]
    assert kinds == ["none", "light", "light+camera", "all"]
    assert plan.seeds == 3
