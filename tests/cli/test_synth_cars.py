"""`derender synth cars` from the command line: what it writes, that it scores, and what it refuses."""

import csv
import json

import pytest

from derender import Derenderer
from derender.cli import main
from derender.presets import MODEL_PRESETS


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("synth") / "cars"
    arguments = ["--classes", "jeep,police", "--image-size", "32", "--light", "wide", "--json", f"{out}.json"]
    assert main(["synth", "cars", "--out", str(out), "--count", "12", *arguments]) == 0
    return out


def test_the_folder_holds_what_was_asked_for(folder):
    with (folder / "params.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 12 and {row["class"] for row in rows} == {"jeep", "police"}
    assert all(max(abs(float(row["light_yaw"])), abs(float(row["light_pitch"]))) >= 34.99 for row in rows)
    facts = json.loads((folder.parent / "cars.json").read_text())
    assert facts["models"] == 3 and facts["settings"]["classes"] == {"jeep": 1.0, "police": 1.0}


def test_geometry_is_evaluated_on_it(folder, tmp_path):
    settings = MODEL_PRESETS["small"]
    small = settings.network.model_copy(update={"image_size": 32, "width": 4, "light_width": 4})
    Derenderer(settings.model_copy(update={"network": small})).save(tmp_path / "model")
    arguments = [
        "--model",
        str(tmp_path / "model"),
        "--data",
        str(folder),
        "--json",
        str(tmp_path / "scores.json"),
    ]
    assert main(["evaluate", "geometry", *arguments]) == 0
    assert json.loads((tmp_path / "scores.json").read_text())["pictures"] == 12


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--classes", "tank"], "classes must be one or more of sedan"),
        (["--view", "side"], "view must be one of usual, wide, frontal"),
        (["--set", "view.azimuth_deg=[50,10]"], "view.azimuth_deg"),
        (["--set", "doors=3"], "unknown setting 'doors'"),
    ],
)
def test_bad_input_is_one_clear_line(tmp_path, capsys, arguments, message):
    assert main(["synth", "cars", "--out", str(tmp_path / "bad"), *arguments]) == 2
    assert message in capsys.readouterr().err.replace("\n", " ")
    assert not (tmp_path / "bad").exists()
