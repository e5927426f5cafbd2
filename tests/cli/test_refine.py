"""`derender refine`: a copy of a model that reads what fitting finds; refusals."""

import json

import pytest
from PIL import Image

import derender
from derender.cli import main
from derender.data.synthetic import faces
from derender.training.held_out_errors import read_errors

SHORT = [
    f"--set={setting}"
    for setting in (
        "images=16",
        "batch_size=8",
        "fitted=8",
        "fit_steps=1",
        "whitening.pictures=8",
        "views=1",
        "spatial=false",
    )
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("faces")
    for index, picture in enumerate(faces.generate(200, image_size=64, seed=9).images):
        Image.fromarray(picture.transpose(1, 2, 0)).save(folder / f"{index}.png")
    return folder


def run(folder, out, *extra, model="rendered-faces-64") -> int:
    return main(["refine", "-m", model, "-d", str(folder), "-o", str(out), *extra])


def test_a_copy_is_written_and_said_what_it_brought(folder, tmp_path, capsys):
    assert run(folder, tmp_path / "mine", *SHORT, "--set", "steps=2", "--json", "-") == 0
    shown = capsys.readouterr()
    said = json.loads(shown.out)
    assert said["pictures"] == 180 and said["held_out"] == 20
    assert said["errors"]["before"] > said["errors"]["fitted"] > 0
    assert "20 held-out images: reconstructed with an error of" in shown.err
    assert set(said["gaps"]) == {"depth", "albedo", "light", "camera"}
    copy = derender.load(tmp_path / "mine")
    assert copy.fitting is not None and copy.fitting.settings.steps == 2 and copy.whitening is not None
    kept = read_errors(tmp_path / "mine")
    assert kept is not None and kept.pictures == 20


def test_what_is_there_is_not_replaced_unasked(folder, tmp_path, capsys):
    (tmp_path / "mine").mkdir()
    assert run(folder, tmp_path / "mine") == 2
    assert "add --force" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("setting", "said"),
    [("image=8", "images"), ("rendered=1.5", "less than or equal to 1"), ("fitted=1", "greater")],
)
def test_settings_that_make_no_sense_are_named(folder, tmp_path, capsys, setting, said):
    assert run(folder, tmp_path / "mine", "--set", setting) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "mine").exists()


def test_a_model_that_cannot_fit_is_told_how_to(folder, tmp_path, capsys):
    assert run(folder, tmp_path / "mine", model="cars-64") == 2
    assert "derender whiten" in capsys.readouterr().err
    assert not (tmp_path / "mine").exists()
