"""`derender whiten`: a copy of the model with other features and the same scenes; refusals."""

import json

import pytest
import torch
from PIL import Image

import derender
from derender.cli import main
from derender.data import read_pictures
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
    few = ("--set", "views=2", "--set", "directions=8", "--set", "spatial=false")
    code = run(folder, tmp_path / "mine", *few, "--json", "-")
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
        ("pictures=0", "2 images or more"),
        ("views=0", "greater than"),
    ],
)
def test_settings_that_make_no_sense_are_named(folder, tmp_path, capsys, setting, said):
    assert run(folder, tmp_path / "mine", "--set", setting) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "mine").exists()


SMALL = ("--set", "pictures=8", "--set", "views=1", "--set", "spatial=false", "--set", "directions=8")
SMALL += ("--set", "examples=12")


def test_features_of_fitted_scenes_when_steps_are_asked_for(folder, tmp_path, capsys):
    made = tmp_path / "fitted"
    assert run(folder, made, *SMALL, "--set", "coordinates=10", "--set", "steps=3", "--set", "weight=2") == 0
    model = derender.load(made)
    assert model.features.fits_scenes and model.fitting.settings.weight == 2
    assert {name: size.shape[1] for name, size in model.embed(torch.rand(1, 3, 64, 64)).items()} == {
        "geometry": 256, "albedo": 256, "light": 256, "camera": 256
    }  # fmt: skip
    table = tmp_path / "table.parquet"
    given = ["embed", "-m", str(made), "-d", str(folder), "-o", str(table)]
    assert main(given) == 0
    assert main([*given, "--force", "--fit-steps", "0", "--json", "-"]) == 0
    assert '"geometry": 246' in capsys.readouterr().out


def test_scenes_that_cannot_be_fitted_are_told_before_anything_is_written(folder, tmp_path, capsys):
    model = derender.load("rendered-faces-64")
    model = model.without_features()
    model.save(tmp_path / "plain")
    for command in (
        ["embed", "-m", str(tmp_path / "plain"), "-d", str(folder), "-o", str(tmp_path / "t.parquet")],
        ["decompose", "-m", str(tmp_path / "plain"), str(folder / "0.png"), "-o", str(tmp_path / "apart")],
    ):
        assert main([*command, "--fit-steps", "5"]) == 2
        said = capsys.readouterr().err
        assert "cannot optimise scenes per image yet" in said and "derender whiten" in said
    assert not (tmp_path / "t.parquet").exists() and not (tmp_path / "apart").exists()


@pytest.mark.parametrize("command", ["decompose", "relight", "rotate", "mesh"])
def test_pictures_are_made_of_fitted_scenes(folder, tmp_path, command):
    assert run(folder, tmp_path / "model", *SMALL, "--set", "coordinates=10") == 0
    given = [command, "-m", str(tmp_path / "model"), str(folder / "0.png")]
    extra = ["--film", "none"] if command in ("relight", "rotate") else []
    for name, steps in (("plain", []), ("fitted", ["--fit-steps", "12"])):
        assert main([*given, *extra, "-o", str(tmp_path / name), *steps]) == 0
    one, two = (sorted(path for path in (tmp_path / name / "0").iterdir()) for name in ("plain", "fitted"))
    assert [path.name for path in one] == [path.name for path in two]
    assert any(a.read_bytes() != b.read_bytes() for a, b in zip(one, two, strict=True))


def test_a_table_of_fitted_scenes_is_searched_as_it_was_made(folder, tmp_path, capsys):
    model, table = tmp_path / "model", tmp_path / "table.parquet"
    assert run(folder, model, *SMALL, "--set", "coordinates=10") == 0
    assert not derender.load(model).features.fits_scenes
    given = ["-m", str(model)]
    assert main(["embed", *given, "-d", str(folder), "-o", str(table), "--fit-steps", "3"]) == 0
    assert derender.FeatureTable.read(table).factors["geometry"].shape == (24, 266)
    asked = [
        "search",
        "--features",
        str(table),
        "--like",
        str(folder / "3.png"),
        *given,
        "--factor",
        "geometry",
    ]
    capsys.readouterr()
    assert main([*asked, "--copies", "--json", "-"]) == 0
    found = json.loads(capsys.readouterr().out)["found"]
    assert found[0]["file"] == "3.png" and found[0]["distance"] == pytest.approx(0, abs=1e-4)


def test_mean_only_moves_features_to_a_mean_of_zero_and_no_distance(folder, tmp_path, capsys):
    assert run(folder, tmp_path / "mine", "--mean-only") == 0
    one, two = derender.load("rendered-faces-64"), derender.load(tmp_path / "mine")
    images = torch.from_numpy(read_pictures(folder, 64).images).float() / 255
    before, after = (
        model.features_from(model.activations(images))["albedo"][:, :192] for model in (one, two)
    )
    assert before.mean(dim=0).norm() > 0.05 * before.std(dim=0).norm()
    assert after.mean(dim=0).norm() < 1e-4 * before.norm(dim=1).mean()
    torch.testing.assert_close(torch.cdist(after, after), torch.cdist(before, before), atol=1e-2, rtol=1e-3)
    assert run(folder, tmp_path / "other", "--mean-only", "--set", "views=2") == 2
    assert "leave out settings" in capsys.readouterr().err
    two = two.without_features()
    two.save(tmp_path / "codes")
    refused = [
        "whiten",
        "-m",
        str(tmp_path / "codes"),
        "-d",
        str(folder),
        "-o",
        str(tmp_path / "x"),
        "--mean-only",
    ]
    assert main(refused) == 2
    assert "not whitened" in capsys.readouterr().err
