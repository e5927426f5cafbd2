"""`derender whiten`, `refine` and `unet`: copies of a model, their measurements and refusals."""

import json

import pytest
import torch
from tests.cli.conftest import face_files, settings
from tests.cli.conftest import run as call

import derender
from derender.cli import main
from derender.storage.places import model_folder
from derender.training.held_out_errors import read_errors

KNOWN = "rendered-faces-64"
FEW = ("pictures=8", "views=2", "spatial=false", "directions=8", "examples=12")
SHORT = ("images=16", "batch_size=8", "fitted=8", "fit_steps=1", "whitening.pictures=8", "views=1")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return face_files(tmp_path_factory.mktemp("faces"), 200, seed=9)


def run(command, folder, out, *pairs, words=(), model=KNOWN) -> int:
    return call(command, folder, "-m", model, "-o", out, *settings(*pairs), *words)


@pytest.fixture(scope="module")
def fits(folder, tmp_path_factory):
    """A model that can fit scenes within 10 coordinates, and does so only on request."""
    made = tmp_path_factory.mktemp("models") / "fits"
    words = ("--limit", "24", "--json", made.with_suffix(".json"))
    assert run("whiten", folder, made, *FEW, "coordinates=10", words=words) == 0
    assert not derender.load(made).features.fits_scenes
    return made


def test_a_whitened_copy_has_other_features_and_the_same_scenes(fits):
    told = json.loads(fits.with_suffix(".json").read_text())
    assert told["pictures"] == 24 and len(told["between_over_within"]["geometry"]) == 8
    one, two = derender.load(KNOWN), derender.load(fits)
    assert torch.linalg.matrix_rank(two.whitening.get_buffer("albedo_map"), rtol=1e-3) == 8
    image = torch.rand(1, 3, 64, 64)
    assert torch.equal(one.decompose(image).depth, two.decompose(image).depth)
    assert read_errors(fits) == read_errors(model_folder(KNOWN)) is not None
    assert not torch.equal(one.embed(image)["albedo"], two.embed(image)["albedo"])


def test_features_hold_fitted_scenes_where_steps_are_set(folder, tmp_path, capsys):
    made, table = tmp_path / "fitted", tmp_path / "table.parquet"
    steps = ("coordinates=10", "steps=3", "weight=2")
    assert run("whiten", folder, made, *FEW, *steps, words=("--limit", "24")) == 0
    model = derender.load(made)
    assert model.features.fits_scenes and model.fitting.settings.weight == 2
    sizes = {name: value.shape[1] for name, value in model.embed(torch.rand(1, 3, 64, 64)).items()}
    assert sizes == dict.fromkeys(("geometry", "albedo", "light", "camera"), 256)
    embed = ["embed", str(folder), "-m", str(made), "--limit", "6", "-o", str(table)]
    assert main([*embed, "--fit-steps", "0", "--json", "-"]) == 0
    assert '"geometry": 246' in capsys.readouterr().out


@pytest.mark.parametrize("command", ["decompose", "rotate"])
def test_images_are_made_of_fitted_scenes(fits, folder, tmp_path, command):
    given = [command, "-m", str(fits), str(folder / "000.png")]
    extra = ["--film", "none", "--stills", "2"] if command == "rotate" else []
    for name, steps in (("plain", []), ("fitted", ["--fit-steps", "4"])):
        assert main([*given, *extra, "-o", str(tmp_path / name), *steps]) == 0
    one, two = (sorted((tmp_path / name / "000").iterdir()) for name in ("plain", "fitted"))
    assert [path.name for path in one] == [path.name for path in two]
    assert any(a.read_bytes() != b.read_bytes() for a, b in zip(one, two, strict=True))


def test_a_table_of_fitted_scenes_is_searched_as_it_was_made(fits, folder, tmp_path, numbers):
    table, given = tmp_path / "table.parquet", ["-m", fits]
    assert call("embed", folder, *given, "--limit", "10", "-o", table, "--fit-steps", "3") == 0
    read = derender.FeatureTable.read(table)
    assert read.factors["geometry"].shape == (10, 266)
    like = str(folder / read.files[3])
    search = ["search", "--features", table, "--like", like, *given, "--factor", "geometry"]
    first = numbers(*search, "--copies")[0]["found"][0]
    assert first["file"] == read.files[3] and first["distance"] == pytest.approx(0, abs=1e-4)


def test_a_model_that_cannot_fit_is_told_how_to(folder, tmp_path, capsys):
    derender.load(KNOWN).without_features().save(tmp_path / "plain")
    plain, steps = ["-m", str(tmp_path / "plain")], ["--fit-steps", "5"]
    for words in (
        ["embed", str(folder), *plain, "-o", str(tmp_path / "t.parquet"), *steps],
        ["decompose", str(folder / "000.png"), *plain, "-o", str(tmp_path / "apart"), *steps],
        ["refine", str(folder), *plain, "-o", str(tmp_path / "mine")],
        ["evaluate", "reconstruction", str(folder), *plain, "--limit", "20", "--cache", "none", *steps],
    ):
        assert main(words) == 2
        assert "derender whiten" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["plain"]


def test_a_refined_copy_comes_with_its_measurements(folder, tiny, tmp_path, numbers):
    assert run("whiten", folder, tmp_path / "fits", *FEW, words=("--limit", "24"), model=tiny) == 0
    short = settings(*SHORT, "spatial=false", "directions=8", "examples=16", "steps=2", "fit_steps=10")
    told, shown = numbers("refine", folder, "-m", tmp_path / "fits", "-o", tmp_path / "mine", *short)
    assert told["pictures"] == 180 and told["held_out"] == 20
    assert told["errors"]["before"] > told["errors"]["fitted"] > 0
    assert "20 held-out images: reconstructed with an error of" in shown
    assert set(told["gaps"]) == {"depth", "albedo", "light", "camera"}
    copy, errors = derender.load(tmp_path / "mine"), read_errors(tmp_path / "mine")
    assert copy.fitting.settings.steps == 2 and copy.whitening is not None and errors.pictures == 20


def test_a_copy_with_u_nets_comes_with_its_errors(folder, tmp_path, numbers):
    short = settings("images=16", "batch_size=8", "unet_width=4")
    told, shown = numbers("unet", folder, "-m", KNOWN, "-o", tmp_path / "mine", *short, "--limit", "12")
    assert told["pictures"] == 12 and told["errors"]["place"] > 0
    assert "mean errors against rendered-faces-64: place" in shown
    copy = derender.load(tmp_path / "mine")
    assert copy.settings.network.encoder == "unet" and copy.whitening is None and copy.fitting is None


@pytest.mark.parametrize(
    ("command", "setting", "message"),
    [
        ("whiten", "direction=8", "whitening.directions"), ("whiten", "views=0", "greater than"),
        ("whiten", "pictures=0", "2 images or more"),
        ("refine", "image=8", "images"),
        ("refine", "rendered=1.5", "less than or equal to 1"),
        ("unet", "precision=16", "precision"), ("unet", "batch_size=1", "greater"),
    ],
)  # fmt: skip
def test_settings_that_make_no_sense_are_named(folder, tmp_path, capsys, command, setting, message):
    assert run(command, folder, tmp_path / "mine", setting) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "mine").exists()


@pytest.mark.parametrize(
    ("command", "change", "shown"),
    [
        ("whiten", "whitening.pictures=77", "pictures: 77"),
        ("refine", "refining.images=88", "images: 88"),
        ("unet", "unet_width=9", "unet_width: 9"),
    ],
)
def test_a_dry_run_shows_all_settings_and_writes_nothing(folder, tmp_path, capsys, command, change, shown):
    assert run(command, folder, tmp_path / "copy", change, words=("--dry-run",)) == 0
    assert shown in capsys.readouterr().out and not (tmp_path / "copy").exists()
