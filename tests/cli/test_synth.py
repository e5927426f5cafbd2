"""`derender synth` from the command line: the folders it writes, and the input it refuses."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from tests.cli.conftest import run
from tests.data.synthetic.test_morphable import dome, saved

from derender.data import synthetic
from derender.data.layouts.rendered import CAR_CLASSES


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("synth")


def made(folder, name: str, *arguments: str) -> list[dict[str, str]]:
    assert run("synth", "faces", "--out", folder / name, "--image-size", 16, *arguments) == 0
    with (folder / name / "params.csv").open() as file:
        return list(csv.DictReader(file))


def test_single_settings_identities_and_expressions(folder):
    rows = made(
        folder, "set", "--count", "12", "--identities", "3", "--expressions", "fear,anger",
        "--set", "light.yaw_deg=[10, 12]", "--set", "view.yaw_sd_deg=0", "--json", str(folder / "set.json"),
    )  # fmt: skip
    assert [row["identity"] for row in rows] == [str(i // 4) for i in range(12)]
    assert {row["expression"] for row in rows} == {"fear", "anger"}
    assert all(10 <= float(row["light_yaw"]) <= 12 and float(row["yaw"]) == 0 for row in rows)
    facts = json.loads((folder / "set.json").read_text())
    assert facts["identities"] == 3 and facts["settings"]["light"]["yaw_deg"] == [10, 12]


def test_a_model_of_ones_own(folder):
    mean, _ = dome()
    saved(folder / "my.npz", components=mean[None] * [0.1, 0.0, 0.0], std=np.ones(1))
    rows = made(folder, "mine", "--count", "8", "--model", str(folder / "my.npz"))
    assert len(rows) == 8 and "hair" not in rows[0]
    with (folder / "mine" / "identities.csv").open() as file:
        assert list(next(csv.reader(file))) == ["identity", "shape_000"]


@pytest.fixture(scope="module")
def car_folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("synth") / "cars"
    arguments = ["--classes", "jeep,police", "--image-size", "32", "--light", "wide", "--json", f"{out}.json"]
    assert run("synth", "cars", "--out", out, "--count", 12, *arguments) == 0
    return out


def test_a_folder_of_cars_holds_what_was_requested(car_folder):
    with (car_folder / "params.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 12 and {row["class"] for row in rows} == {"jeep", "police"}
    assert all(max(abs(float(row["light_yaw"])), abs(float(row["light_pitch"]))) >= 34.99 for row in rows)
    facts = json.loads((car_folder.parent / "cars.json").read_text())
    assert facts["models"] == 3 and facts["settings"]["classes"] == {"jeep": 1.0, "police": 1.0}


@pytest.mark.parametrize(
    ("kind", "arguments", "message"),
    [
        ("faces", ["--light", "noon"], "unknown light 'noon': choose usual, wide or frontal"),
        ("faces", ["--view", "above"], "unknown view 'above': choose usual, wide or frontal"),
        ("faces", ["--set", "light.colour=red"], "?: there are light.yaw_deg, light.pitch_deg"),
        ("faces", ["--set", "light.yaw_deg"], "write key=value"),
        ("faces", ["--set", "light.yaw_deg=[-60,99]"], "setting 'light.yaw_deg': must be two numbers"),
        ("faces", ["--expressions", "smug"], "'expressions': must be one or more of neutral, happiness"),
        ("faces", ["--tracks", "2", "--count", "5"], "--count does not go with --tracks"),
        ("faces", ["--model", "nowhere.npz"], "nowhere.npz does not exist: expected a morphable model"),
        ("faces", ["--benchmark", "--count", "5"], "--benchmark has settings of its own"),
        ("faces", ["--benchmark", "--identities", "5"], "--benchmark has settings of its own"),
        ("cars", ["--benchmark", "--classes", "jeep"], "--benchmark has settings of its own"),
        ("cars", ["--classes", "tank"], "'classes': must be one or more of sedan"),
        ("cars", ["--view", "side"], "choose usual, wide or frontal"),
        ("cars", ["--set", "view.azimuth_deg=[50,10]"], "view.azimuth_deg"),
        ("cars", ["--set", "doors=3"], "unknown setting 'doors'"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(folder, capsys, kind, arguments, message):
    assert run("synth", kind, "--out", folder / "bad", *arguments) == 2
    printed = capsys.readouterr().err.strip()
    assert message in printed and len(printed.splitlines()) == 1
    assert not (folder / "bad").exists()


@pytest.mark.parametrize("kind", ["faces", "cars"])
def test_the_benchmark_has_fixed_sets_of_different_people(kind, folder, monkeypatch):
    small = {
        name: replace(part, count=48 if name == "tracks" else 16)
        for name, part in synthetic.PARTS[kind].items()
    }
    monkeypatch.setitem(synthetic.PARTS, kind, small)
    assert run("synth", kind, "--benchmark", "--out", folder / f"all-{kind}", "--image-size", 16) == 0
    tables = {}
    for name, part in small.items():
        with (folder / f"all-{kind}" / name / "params.csv").open() as file:
            tables[name] = list(csv.DictReader(file))
        assert len(tables[name]) == part.count
        assert (folder / f"all-{kind}" / name / "depth").exists() == (name == "test")
    assert len({rows[0]["lx"] for rows in tables.values()}) == len(tables)  # no draw is that of another part
    if kind == "cars":
        assert {row["class"] for row in tables["test"]} <= {*CAR_CLASSES}
    else:
        assert (folder / "all-faces" / "tracks" / "tracks" / "id0000" / "track_007" / "005.jpg").exists()
