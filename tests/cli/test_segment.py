"""Segmentation on the command line: tables, overlays, going on, and ways to get it wrong."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from derender import Derenderer, FeatureTable
from derender.cli import main
from derender.data import MASK_CLASSES


@pytest.fixture(scope="module")
def parts(tmp_path_factory) -> Path:
    """A made-up CelebAMask-HQ: hair over skin over cloth, by colour."""
    folder, random = tmp_path_factory.mktemp("segment") / "faces", np.random.default_rng(0)
    colours = np.zeros((19, 3), int)
    colours[[1, 13, 18]] = [[220, 170, 140], [60, 40, 20], [40, 60, 160]]
    (folder / "images").mkdir(parents=True)
    (folder / "masks").mkdir()
    for row in range(16):
        mask = np.full((32, 32), 1, np.uint8)
        mask[: random.integers(5, 12)] = 13
        mask[random.integers(22, 28) :] = 18
        picture = colours[mask] + random.integers(0, 30, (32, 32, 3))
        Image.fromarray(picture.astype(np.uint8)).save(folder / "images" / f"{row}.jpg", quality=95)
        Image.fromarray(mask).save(folder / "masks" / f"{row}.png")
    return folder


def model(folder: Path, encoder: str) -> Path:
    sizes = {"image_size": 32, "width": 4, "light_width": 4, "unet_width": 4, "encoder": encoder}
    return Derenderer.from_preset("small", seed=0, **sizes).save(folder / encoder)


def test_tables_overlays_and_going_on(parts, tmp_path, capsys, numbers, refused):
    net, out = model(tmp_path, "unet"), tmp_path / "out"
    words = ["evaluate", "segment", "-m", net, "-d", parts, "--out", out, "--epochs", 1, "--batch-size", 8]
    words += ["--resamples", 20, "--variants", "joint,random"]
    text = tmp_path / "table.md"
    assert main([str(word) for word in [*words, "--seeds", 1]]) == 0
    shown = capsys.readouterr()
    assert "13 images learned, 3 tested (by a hash" in shown.out and "2 runs computed, 0 found" in shown.err
    assert "each place's class" in shown.out and "paper: Joint Encoders Frozen" in shown.out
    (sheet,) = out.glob("overlays-*.png")
    with Image.open(sheet) as drawn:
        assert drawn.width > 4 * 160
    again = [*words, "--seeds", 2, "--markdown", text]
    told, shown = numbers(*again)
    assert "2 runs computed, 2 found" in shown
    assert list(told["rows"])[:2] == ["joint encoders", "random start"] and told["seeds"] == [0, 1]
    joint = told["rows"]["joint encoders"]
    assert set(joint["scores"]) == {"mean_iou", "top10_iou", "pixel_accuracy"} and joint["runs"] == 2
    assert set(joint["class_iou"]) == set(MASK_CLASSES) and joint["class_iou"]["hat"] is None
    assert told["rows"]["PCA"]["scores"]["mean_iou"]["value"] > 0
    assert "joint encoders" in text.read_text()
    assert "exists already" in refused(*again)


def test_the_papers_table_beside_the_papers_numbers(parts, tmp_path, capsys, numbers, refused):
    words = ["compare", "--table", "segmentation", "-m", f"ours={model(tmp_path, 'unet')}", "-d", parts]
    words += ["--epochs", 1, "--resamples", 20, "--cache", tmp_path / "cache", "--seeds"]
    text, typeset = tmp_path / "t.md", tmp_path / "t.tex"
    told, _ = numbers(*words, 1, "--markdown", text, "--latex", typeset)
    ours = told["parts"]["ours"]
    assert told["number"] == 3 and ours["differs"].startswith("subset: 13 + 3 images at 32 x 32, 19 classes")
    names = ["joint encoders", "geometry encoder", "albedo encoder", "joint encoders, frozen", "random start"]
    names += ["each place's class", "PCA"]
    assert list(ours["rows"]) == names and len(ours["paper"]) == 5
    first = text.read_text().split("\n\n")[1]
    assert [line.split(" | ")[0] for line in first.splitlines()[2:]] == [
        *(f"| {name}" if at < 4 else f"| *{name}*" for at, name in enumerate(names)),
        *(f"| paper: {row['method']}" for row in ours["paper"]),
    ]
    assert typeset.read_text().count(r"\begin{table}") == 4
    assert main([str(word) for word in [*words, 1]]) == 0
    assert "0 results computed, 5 found" in capsys.readouterr().err
    features = FeatureTable(("a",), {"geometry": np.ones((1, 2))}).write(tmp_path / "f.parquet")
    feature = ("compare", "--table", "segmentation", "-f", f"a={features}", "-d", parts)
    assert "features do not do" in refused(*feature)
    cars = ("compare", "--table", "cars", "-f", f"a={features}", "--masks", parts)
    assert "masks go with the table of segmentation, not with cars" in refused(*cars)
    assert "no U-Net encoder" in refused(*words[:4], f"plain={model(tmp_path, 'conv')}", *words[5:], 1)


def test_masks_of_ones_own(parts, tmp_path, capsys):
    net = model(tmp_path, "unet")
    (parts / "masks" / "classes.txt").write_text("\n".join(MASK_CLASSES))
    words = ["evaluate", "segment", "-m", net, "-d", parts / "images", "--masks", parts / "masks"]
    words += ["--out", tmp_path / "out", "--epochs", 1, "--seeds", 1, "--variants", "geometry"]
    assert main([str(word) for word in [*words, "--resamples", 10]]) == 0
    assert "3 of 19 classes" in capsys.readouterr().out


def test_bad_input_is_one_line(parts, tmp_path, refused):
    net, plain = model(tmp_path, "unet"), model(tmp_path, "conv")
    segment = ("evaluate", "segment", "--out", tmp_path / "out", "-m", net)
    assert "no U-Net encoder for albedo" in refused(*segment[:4], "-m", plain, "-d", parts)
    assert "holds no masks" in refused(*segment, "-d", parts / "images")
    wrong = refused(*segment, "-d", parts, "--variants", "gemetry")
    assert "unknown variant 'gemetry'; did you mean 'geometry'" in wrong
    one = tmp_path / "one"
    (one / "images").mkdir(parents=True)
    (one / "masks").mkdir()
    for row in range(6):
        Image.fromarray(np.full((8, 8, 3), 40 * row, np.uint8)).save(one / "images" / f"{row}.png")
        Image.fromarray(np.zeros((8, 8), np.uint8)).save(one / "masks" / f"{row}.png")
    assert "show one class only (background)" in refused(*segment, "-d", one)
    assert not (tmp_path / "out").exists()
