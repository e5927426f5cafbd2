"""`--whiten-on`: codes not whitened, and controls with the model's whitening, in the tables of features."""

import json
from pathlib import Path

import pytest

from derender import Derenderer
from derender.cli import main
from derender.data.synthetic import FaceSettings, faces, write

QUICK = ["--resamples", "20", "--untrained-seeds", "1"]


@pytest.fixture(scope="module")
def rendered(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("whitened") / "faces"
    write(faces.generate(32, 32, 0, FaceSettings(pictures_per_identity=8)), folder)
    return folder


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    net = Derenderer.from_preset("small", seed=0, image_size=32, width=4, light_width=4, code_size=8)
    return net.save(tmp_path_factory.mktemp("whitened") / "model")


def test_controls_get_the_models_whitening(model, rendered, tmp_path, capsys):
    words = ["evaluate", "cluster", "-m", model, "-d", rendered, "-l", "identity", "--whiten-on", rendered]
    told = []
    for _ in range(2):
        capsys.readouterr()
        files = ["--cache", tmp_path / "cache", "--json", "-"]
        assert main([str(word) for word in (*words, *QUICK, *files)]) == 0
        shown = capsys.readouterr()
        told.append(json.loads(shown.out)["rows"])
    assert "0 results computed" in shown.err and told[0] == told[1]
    assert {name: row["control"] for name, row in told[0].items()} == {
        "geometry + albedo": False, "geometry + albedo, whitened here": False, "untrained encoder": True,
        "PCA (8)": True, "pixels": True, "untrained encoder, whitened": True, "PCA (8), whitened": True,
        "majority": True, "chance": True,
    }  # fmt: skip


def test_a_table_of_features_renders_nothing(tmp_path, capsys):
    words = ["evaluate", "cluster", "-f", tmp_path / "F.parquet", "-l", "a", "--whiten-on", tmp_path]
    assert main([str(word) for word in words]) == 2
    assert "--whiten-on renders pictures again" in capsys.readouterr().err
