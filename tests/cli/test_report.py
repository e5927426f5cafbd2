"""`derender report` as a person meets it: with data and without, for a broken run, for bad input."""

import json
import re
from pathlib import Path

import pytest
from tests.cli.conftest import noise

from derender import Derenderer
from derender.cli import main
from derender.training.config import resolve
from derender.training.run_folder import append_metrics, start_run


@pytest.fixture(scope="module")
def photos(tmp_path_factory) -> Path:
    return noise(tmp_path_factory.mktemp("report") / "photos", 40, name="{}<b>.png")


@pytest.fixture
def run(tmp_path) -> Path:
    """A run that was stopped early, with a small model; it was given 40 images."""
    settings = ["model.network.image_size=32", "model.network.width=4", "model.network.light_width=4"]
    config = resolve("small", [*settings, "images=96", "split=[0.5,0.25,0.25]"])
    folder = start_run(tmp_path / "run", config, {"pictures": 40}, "cpu")
    for images in (32, 64):
        append_metrics(folder, {"kind": "train", "images": images, "seconds": 1.0, "l1": 0.1, "loss": 1.0})
    Derenderer.seeded(config.model, 0).save(folder.model)
    return folder.path


def test_page_with_data_tells_of_its_held_out_part(run, photos, tmp_path):
    out, told = tmp_path / "page.html", tmp_path / "told.json"
    words = ["--data", str(photos), "--out", str(out), "--json", str(told)]
    assert main(["report", str(run), *words]) == 0
    html = out.read_text()
    assert "The 10 images of the run" in html and "test part" in html
    assert "<b>.png" not in html and "&lt;b&gt;.png" in html
    assert "64 of 96 planned images were seen" in html
    assert not re.search(r'(?:src|href)="(?!data:|#)', html)
    failed = json.loads(told.read_text())["failed"]
    assert [reason.partition(":")[0] for reason in failed] == [
        "Does each feature hold its own factor?",  # of 10 images
        "Labels explained by factors",
    ]
    assert all(name in html for name in ("Films", "Scores beside controls", "Decomposed"))


def test_page_without_data_or_model_says_what_is_missing(run, photos, tmp_path, capsys):
    assert main(["report", str(run)]) == 0
    assert "add images" in capsys.readouterr().err
    assert (run / "report.html").read_text().count("<section") == 3
    for file in (run / "model").iterdir():
        file.unlink()
    (run / "model").rmdir()
    assert main(["report", str(run), "--data", str(photos)]) == 0
    html = (run / "report.html").read_text()
    assert "There is no saved model" in html and "Everything about the model" in html
    assert "The data" in html


def test_bad_questions(run, photos, tmp_path, refused):
    assert "no run in" in refused("report", tmp_path)
    assert "--truth and --label need images" in refused("report", run, "--label", "age")
    assert "has no label 'age'" in refused("report", run, "--data", photos, "--label", "age")
    taken = tmp_path / "taken.html"
    taken.write_text("mine")
    assert "exists already" in refused("report", run, "--out", taken)
    assert taken.read_text() == "mine"
