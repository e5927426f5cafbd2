"""`evaluate geometry` and `reconstruction` of fitted scenes; models that cannot fit are told."""

import json

import pytest

import derender
from derender.cli import main


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made") / "faces"
    assert main(["synth", "faces", "--out", str(folder), "--count", "6", "--seed", "3"]) == 0
    return folder


def asked(kind, made, capsys, *extra) -> dict:
    given = [
        "evaluate",
        kind,
        "-m",
        "rendered-faces-64",
        "-d",
        str(made),
        "--cache",
        "none",
        "--resamples",
        "5",
    ]
    capsys.readouterr()
    assert main([*given, "--json", "-", *extra]) == 0
    return json.loads(capsys.readouterr().out)


def test_pictures_are_rendered_better_from_fitted_scenes(made, capsys):
    read = asked("reconstruction", made, capsys)["reconstruction"]
    fitted = asked("reconstruction", made, capsys, "--fit-steps", "20")["reconstruction"]
    assert fitted["model"]["l1"] < 0.95 * read["model"]["l1"]
    assert fitted["untrained"]["l1"] == pytest.approx(read["untrained"]["l1"])  # is not fitted


def test_geometry_of_fitted_scenes_is_another(made, capsys):
    read = asked("geometry", made, capsys)["geometry"]
    fitted = asked("geometry", made, capsys, "--fit-steps", "5")["geometry"]
    assert fitted["model"] != read["model"] and fitted["untrained"] == read["untrained"]


def test_a_model_that_cannot_is_told(made, tmp_path, capsys):
    model = derender.load("rendered-faces-64")
    model = model.without_features()
    model.save(tmp_path / "plain")
    given = ["evaluate", "geometry", "-m", str(tmp_path / "plain"), "-d", str(made), "--fit-steps", "5"]
    assert main(given) == 2
    assert "cannot optimise scenes per image yet" in capsys.readouterr().err
