"""`evaluate geometry` and `reconstruction` of fitted scenes."""

import pytest
from tests.cli.conftest import run


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made") / "faces"
    assert run("synth", "faces", "--out", folder, "--count", "6", "--seed", "3") == 0
    return folder


def asked(kind, made, numbers, *extra) -> dict:
    given = ["evaluate", kind, "-m", "rendered-faces-64", "-d", made, "--cache", "none", "--resamples", "5"]
    return numbers(*given, *extra)[0]


def test_pictures_are_rendered_better_from_fitted_scenes(made, numbers):
    read = asked("reconstruction", made, numbers)["reconstruction"]
    fitted = asked("reconstruction", made, numbers, "--fit-steps", "20")["reconstruction"]
    assert fitted["model"]["l1"] < 0.95 * read["model"]["l1"]
    assert fitted["untrained"]["l1"] == pytest.approx(read["untrained"]["l1"])  # is not fitted


def test_geometry_of_fitted_scenes_is_another(made, numbers):
    read = asked("geometry", made, numbers)["geometry"]
    fitted = asked("geometry", made, numbers, "--fit-steps", "5")["geometry"]
    assert fitted["model"] != read["model"] and fitted["untrained"] == read["untrained"]
