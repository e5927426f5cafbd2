"""`evaluate disentangle` and `evaluate geometry`: images drawn, numbers told, bad words refused."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from derender.data.synthetic import faces, write
from derender.model import Derenderer

SIZE = 32


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    """An untrained model on disk, for 32 pixels."""
    made = Derenderer.from_preset("small", seed=0, image_size=SIZE, width=4, light_width=4, code_size=12)
    return made.save(tmp_path_factory.mktemp("disentangle") / "model")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Generated faces, in memory."""
    return faces.generate(24, SIZE, 0)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory, made) -> Path:
    folder = tmp_path_factory.mktemp("disentangle") / "faces"
    write(made, folder)
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
    refused = partial(refused, "evaluate", "disentangle", "-m", model, "-d", rendered)

    assert "must end in .png" in refused("--out", tmp_path / "card.jpg")
    taken = tmp_path / "taken.png"
    taken.write_bytes(b"mine")
    assert "--force" in refused("--out", taken) and taken.read_bytes() == b"mine"
    assert "is not one of 'lasso', 'trees', 'none'" in refused("--dimensions", "forest")
    assert "needs 20 images or more" in refused("--limit", "5")


def test_geometry_of_pictures_beside_depth_maps(model, made, tmp_path, numbers):
    """unsup3d's layout, written here at twice the model's size: scores as for the same maps in our own."""
    folder = tmp_path / "pairs" / "test"
    for kind in ("image", "depth"):
        (folder / kind).mkdir(parents=True)
    code = np.where(made.mask, np.clip((1.1 - made.depth) / 0.2, 1 / 65_535, 1) * 65_535, 0)
    for row in range(6):
        picture = Image.fromarray(made.images[row].transpose(1, 2, 0))
        picture.resize((2 * SIZE, 2 * SIZE), Image.Resampling.NEAREST).save(folder / f"image/{row}_image.png")
        depth = code[row].round().astype(np.uint16).repeat(2, axis=0).repeat(2, axis=1)
        Image.fromarray(depth).save(folder / f"depth/{row}_depth.png")
    results = []
    own = tmp_path / "own"
    write(made, own)
    for data in (tmp_path / "pairs", own):
        words = ["evaluate", "geometry", "-m", model, "-d", data, "--limit", "6"]
        words += ["--cache", tmp_path / "cache", "--resamples", "50"]
        results.append(numbers(*words)[0])
    again, shown = numbers(*words, "--markdown", tmp_path / "geometry.md")
    assert again == results[1] and "0 results computed, 3 found" in shown
    assert "| prediction | SIDE x 100 ↓ | 95 % | MAD ↓ | 95 % |" in (tmp_path / "geometry.md").read_text()
    pairs, ours = results
    assert pairs["pictures"] == 6 and "factors" not in pairs and "factors_untrained" in ours
    for row in ("model", "average_depth", "plane", "untrained"):
        assert pairs["geometry"][row]["side"] == pytest.approx(ours["geometry"][row]["side"], rel=0.02)
    assert pairs["geometry"]["plane"]["side"] > pairs["geometry"]["average_depth"]["side"]
    assert pairs["reconstruction"]["model"]["ssim"] is not None
    side = ours["intervals"]["geometry"]["model"]["scores"]["side"]
    assert side["value"] == pytest.approx(ours["geometry"]["model"]["side"])
    assert side["low"] <= side["value"] <= side["high"]
    rows = ours["intervals"]["reconstruction"]
    assert list(rows) == ["model", "mean image", "PCA (1)", "untrained model"]
    assert rows["model"]["versus"]["l1"]["rival"] in rows
    assert 0 < ours["factors"]["albedo"] <= ours["factors"]["albedo_global"]
    assert ours["factors"]["light_aligned"]["mean_deg"] <= ours["factors"]["light"]["mean_deg"] + 1
