"""`derender evaluate robustness`: curves of generated and real images, charts, and ways to get it wrong."""

from functools import partial
from pathlib import Path

import pytest
from PIL import Image

from derender.data.synthetic import FaceSettings, faces, write

QUICK = ["--resamples", 20, "--untrained-seeds", 1, "--seeds", 2, "--angles", "0,40", "--cache"]
KNN = ["--head", "k-NN"]


@pytest.fixture(scope="module")
def rendered(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("robustness") / "faces"
    write(faces.generate(40, 32, 0, FaceSettings(pictures_per_identity=10)), folder)
    return folder


def test_generated_faces_by_angle_and_light(tiny, tmp_path, numbers):
    words = ["evaluate", "robustness", "-m", tiny, "--people", 4, "--learned", 6, *QUICK, tmp_path / "cache"]
    files = ["--html", tmp_path / "page.html", "--markdown", tmp_path / "t.md", "--latex", tmp_path / "t.tex"]
    told, shown = numbers(*words, *files)
    assert list(told["curves"]) == ["yaw", "light"] and told["how"] == "identity of generated faces"
    names = ["geometry + albedo", "geometry", "albedo", "light", "camera"]
    controls = ["untrained encoder", "PCA (6)", "pixels", "majority"]
    rows = told["curves"]["yaw"]["accuracy"]
    assert list(rows) == [*names, *controls] and [rows[name]["control"] for name in controls] == [True] * 4
    assert rows["majority"]["scores"]["area"]["value"] == 0.25
    assert told["curves"]["light"]["n_tested"] == [8, 8, 16] and told["n_learned"]["yaw"] == 19
    assert "camera yaw: geometry + albedo: area" in shown
    page = (tmp_path / "page.html").read_text()
    assert "<svg" in page and "light from the side" in page
    assert (tmp_path / "t.tex").read_text().count(r"\begin{table}") == 6
    assert "| geometry + albedo |" in (tmp_path / "t.md").read_text()
    again, shown = numbers(*words, "--score", "balanced", "--out", tmp_path / "curves.png")
    assert "0 results computed, 12 found" in shown and again["curves"] == told["curves"]
    with Image.open(tmp_path / "curves.png") as chart:
        assert chart.width > 800


def test_pictures_rendered_again_and_pictures_of_known_angles(tiny, rendered, tmp_path, numbers):
    words = ["evaluate", "robustness", "-m", tiny, "--axes", "light", *QUICK, "none", "-d", rendered]
    told, _ = numbers(*words, "--label", "expression", "--min-count", 4, "--groups", "identity", *KNN)
    assert told["pictures"] == "render" and told["how"].endswith("re-rendered")
    tested = told["curves"]["light"]["n_tested"]
    assert tested[0] == tested[1] and tested[2] == 2 * tested[0]
    told, _ = numbers(*words, *KNN, "--pictures", "truth", "--out", tmp_path / "curves.svg")
    light = told["curves"]["light"]
    assert told["kind"] == "classes" and len(light["levels_deg"]) == 4
    assert light["levels_deg"] == sorted(light["levels_deg"]) and light["n_tested"][0] == light["n_tested"][1]
    assert (tmp_path / "curves.svg").read_text().startswith("<svg")


def test_tracks_in_light_beyond_training(tiny, tmp_path, numbers):
    folder = tmp_path / "tracks"
    settings = FaceSettings(tracks=8, frames=2)
    write(faces.generate(32, 32, 0, settings), folder)
    words = ["evaluate", "robustness", "-m", tiny, "-d", folder, "--pictures", "truth", "--axes", "yaw"]
    told, _ = numbers(*words, *KNN, *QUICK, "none")
    assert told["curves"]["yaw"]["n_tested"] == [4, 4, 6, 6, 4] and told["names"] == ["identity"]


def test_bad_words(tiny, rendered, tmp_path, refused):
    refused = partial(refused, "evaluate", "robustness", "-m", tiny, "--cache", "none")

    assert "--angles 'wide' should read like" in refused("--angles", "wide")
    assert "within 0..60 degrees for pitch" in refused("--axes", "pitch")
    assert "unknown head 'svm'" in refused("--head", "svm")
    assert "unknown kind of images 'facess'; did you mean 'faces'" in refused("--pictures", "facess")
    assert "take no images" in refused("--pictures", "cars", "-d", rendered)
    assert "need images" in refused("--pictures", "truth")
    assert "are asked one label" in refused("--attributes")
    assert "unknown label 'smile'" in refused("-d", rendered, "-l", "smile")
    assert "must end in .svg, .png" in refused("--out", tmp_path / "curves.pdf")
    taken = tmp_path / "taken.svg"
    taken.write_text("mine")
    assert "--force" in refused("--out", taken) and taken.read_text() == "mine"
    assert "is not one of 'accuracy', 'balanced'" in refused("--score", "f1")
    assert "two models have the name 'a'" in refused("-m", f"a={tiny}", "-m", f"a={tiny}")
