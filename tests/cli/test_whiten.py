"""`derender whiten`: a copy of the model with other features and the same scenes; refusals."""

import json

import pytest
import torch
from PIL import Image

import derender
from derender.cli import main
from derender.data.synthetic import faces


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("faces")
    for index, picture in enumerate(faces.generate(24, image_size=64, seed=9).images):
        Image.fromarray(picture.transpose(1, 2, 0)).save(folder / f"{index}.png")
    return folder


def run(folder, out, *extra) -> int:
    return main(["whiten", "-m", "rendered-faces-64", "-d", str(folder), "-o", str(out), *extra])


def test_a_copy_with_other_features_and_the_same_scenes(folder, tmp_path, capsys):
    code = run(folder, tmp_path / "mine", "--set", "views=2", "--set", "directions=8", "--json", "-")
    assert code == 0
    said = json.loads(capsys.readouterr().out)
    assert said["pictures"] == 24
    assert len(said["between_over_within"]["geometry"]) == 8
    one, two = derender.load("rendered-faces-64"), derender.load(tmp_path / "mine")
    assert torch.linalg.matrix_rank(two.whitening.get_buffer("albedo_map"), rtol=1e-3) == 8
    picture = torch.rand(1, 3, 64, 64)
    assert torch.equal(one.decompose(picture).depth, two.decompose(picture).depth)
    assert not torch.equal(one.embed(picture)["albedo"], two.embed(picture)["albedo"])


def test_what_is_there_is_not_replaced_unasked(folder, tmp_path, capsys):
    (tmp_path / "mine").mkdir()
    assert run(folder, tmp_path / "mine") == 2
    assert "add --force" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("direction=8", "whitening.directions"),
        ("pictures=0", "2 pictures or more"),
        ("views=0", "greater than"),
    ],
)
def test_settings_that_make_no_sense_are_named(folder, tmp_path, capsys, setting, said):
    assert run(folder, tmp_path / "mine", "--set", setting) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "mine").exists()
