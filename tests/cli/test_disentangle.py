"""`evaluate disentangle`, `geometry`, of fitted scenes too: images drawn, numbers told, bad words refused."""

from functools import partial
from pathlib import Path

import pytest
from PIL import Image
from tests.cli.conftest import run

from derender.data.synthetic import faces, write
from derender.model import Derenderer

SIZE = 32


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    """An untrained model on disk, for 32 pixels."""
    made = Derenderer.from_preset("small", seed=0, image_size=SIZE, width=4, light_width=4, code_size=12)
    return made.save(tmp_path_factory.mktemp("disentangle") / "model")


@pytest.fixture(scope="module")
def rendered(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("disentangle") / "faces"
    write(faces.generate(24, SIZE, 0), folder)
    return folder


def test_the_card_is_printed_drawn_and_written(model, rendered, tmp_path, numbers):
    out = tmp_path / "card.png"
    words = ["evaluate", "disentangle", "-m", model, "-d", rendered, "--seeds", "1", "--swap-pictures", "4"]
    words += ["--cache", tmp_path / "cache"]
    text, typeset = tmp_path / "card.md", tmp_path / "card.tex"
    told, shown = numbers(*words, "--out", out, "--markdown", text, "--latex", typeset)
    assert text.read_text().count("| :--- |") == typeset.read_text().count(r"\begin{table}") == 6
    assert told["pictures"] == 24 and told["features"]["geometry"] == 12 and told["seeds"] == [0]
    assert list(told["rows"]) == ["model", "untrained encoder", "shuffled rows", "random pixels", "PCA"]
    scores = told["rows"]["model"][0]
    assert len(scores["swap"]["moved"]) == 4 and scores["truth"]["factors"][:2] == ["ambient", "diffuse"]
    assert told["rows"]["random pixels"][0]["swap"] is None
    for words_shown in ("Swap test", "true factor", "swap test, decoded:", "random pixels"):
        assert words_shown in shown
    with Image.open(out) as sheet:
        assert sheet.width > 900
    low, high = scores["swap"]["ratio_95"]
    assert low < scores["swap"]["ratio"] < high and "resampled" not in scores["swap"]
    assert "6 results computed, 0 found" in shown
    again, shown = numbers(*words)
    assert again == told and "0 results computed, 6 found" in shown


def test_bad_words(model, rendered, tmp_path, refused):
    printed = refused("evaluate", "brightness", "-m", model, "-d", rendered / "images")
    assert "for photographs name a label of groups (--by LABEL)" in printed
    refused = partial(refused, "evaluate", "disentangle", "-m", model, "-d", rendered)
    assert "must end in .png" in refused("--out", tmp_path / "card.jpg")
    taken = tmp_path / "taken.png"
    taken.write_bytes(b"mine")
    assert "--force" in refused("--out", taken) and taken.read_bytes() == b"mine"
    assert "is not one of 'lasso', 'none'" in refused("--dimensions", "forest")
    assert "needs 20 images or more" in refused("--limit", "5")


def test_geometry_beside_controls_with_intervals(model, rendered, tmp_path, numbers):
    words = ["evaluate", "geometry", "-m", model, "-d", rendered, "--limit", "6"]
    words += ["--cache", tmp_path / "cache", "--resamples", "50"]
    told = numbers(*words)[0]
    again, shown = numbers(*words, "--markdown", tmp_path / "geometry.md")
    assert again == told and "0 results computed, 3 found" in shown
    assert "| prediction | SIDE x 100 ↓ | 95 % | MAD ↓ | 95 % |" in (tmp_path / "geometry.md").read_text()
    assert told["pictures"] == 6 and told["factors"]["untrained"]["albedo"] > 0
    assert told["geometry"]["plane"]["side"] > told["geometry"]["average_depth"]["side"]
    assert told["reconstruction"]["model"]["ssim"] is not None
    side = told["intervals"]["geometry"]["model"]["scores"]["side"]
    assert side["value"] == pytest.approx(told["geometry"]["model"]["side"])
    assert side["low"] <= side["value"] <= side["high"]
    rows = told["intervals"]["reconstruction"]
    assert list(rows) == ["model", "mean image", "PCA (1)", "untrained model"]
    assert rows["model"]["versus"]["l1"]["rival"] in rows
    ours = told["factors"]["model"]
    assert 0 < ours["albedo"] <= ours["albedo_global"] and ours["aligned"] <= ours["light"] + 1


@pytest.mark.parametrize("protocol", ["geometry", "brightness"])
def test_a_rendered_set_of_another_size_is_refused_with_what_to_do(protocol, rendered, refused):
    printed = refused("evaluate", protocol, "-m", "rendered-faces-64", "-d", rendered)
    assert "the images are 32x32, the model takes 64x64: render the set at that size" in printed
    assert "--image-size 64" in printed and "or give another model" in printed


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
