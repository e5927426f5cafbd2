"""`derender unet`: a copy of a model that segmentation takes; refusals."""

import json

import pytest
from PIL import Image

import derender
from derender.cli import main
from derender.data.synthetic import faces


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("faces")
    for index, picture in enumerate(faces.generate(12, image_size=64, seed=9).images):
        Image.fromarray(picture.transpose(1, 2, 0)).save(folder / f"{index}.png")
    return folder


def run(folder, out, *extra) -> int:
    return main(["unet", "-m", "rendered-faces-64", "-d", str(folder), "-o", str(out), *extra])


def test_a_copy_with_u_nets_is_written_and_said_how_good_it_is(folder, tmp_path, capsys):
    short = ("--set", "images=16", "--set", "batch_size=8", "--set", "unet_width=4")
    assert run(folder, tmp_path / "mine", *short, "--json", "-") == 0
    shown = capsys.readouterr()
    said = json.loads(shown.out)
    assert said["pictures"] == 12 and said["errors"]["place"] > 0
    assert "mean errors against rendered-faces-64: place" in shown.err
    copy = derender.load(tmp_path / "mine")
    assert copy.settings.network.encoder == "unet" and copy.whitening is None and copy.fitting is None


def test_what_is_there_is_not_replaced_unasked(folder, tmp_path, capsys):
    (tmp_path / "mine").mkdir()
    assert run(folder, tmp_path / "mine") == 2
    assert "add --force" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("setting", "said"), [("image=8", "images"), ("precision=16", "precision"), ("batch_size=1", "greater")]
)
def test_settings_that_make_no_sense_are_named(folder, tmp_path, capsys, setting, said):
    assert run(folder, tmp_path / "mine", "--set", setting) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "mine").exists()
