"""Images unlike a model's training are told, and the bundled model that fits them is named."""

import numpy as np
import pytest
import torch
from PIL import Image

import derender
from derender.cli import main
from derender.data import ImageSet
from derender.data.synthetic import cars
from derender.features.embedding import unlike_training


@pytest.fixture(scope="module")
def made():
    return np.stack([cars.generate(1, 64, seed=seed).images[0] for seed in range(12)])


def test_another_model_is_named(made):
    images = ImageSet(made, tuple(map(str, range(12))), {}, source="cars")
    assert unlike_training(images, "cars-64") == ""
    line = unlike_training(images, "faces-64")
    assert "of 12 images are reconstructed worse than 99 %" in line and line.endswith("try --model cars-64")


def test_embed_tells_it_and_keeps_identical_images_on_request(made, tmp_path, capsys):
    for number, pixels in enumerate(made[:6]):
        Image.fromarray(pixels.transpose(1, 2, 0)).save(tmp_path / f"{number}.png")
    (tmp_path / "copy.png").write_bytes((tmp_path / "0.png").read_bytes())
    words = ["embed", str(tmp_path), "--model", "rendered-faces-64", "--fit-steps", "0", "--out"]
    assert main([*words, str(tmp_path / "all.parquet"), "--keep-duplicates"]) == 0
    assert "try --model cars-64" in capsys.readouterr().err
    assert len(derender.FeatureTable.read(tmp_path / "all.parquet")) == 7


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_device_that_is_missing_is_named():
    with pytest.raises(ValueError, match="no CUDA device here"):
        derender.load("cars-64").to("cuda")
    with pytest.raises(ValueError, match="unknown device: give 'cpu' or 'cuda'"):
        derender.load("rendered-faces-64", device="gpu")
    with pytest.raises(TypeError, match="None"):
        derender.load(None)
