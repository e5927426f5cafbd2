"""Bad input to every `derender evaluate`: one clear line, and nothing scored in silence."""

from pathlib import Path

import numpy as np
import pytest
import torch

from derender import Derenderer, FeatureTable
from derender.data.synthetic import faces, write

ROWS = 40
ROOM = ["--cache", "none", "--resamples", "10"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A model whose weights are no numbers, rendered images, and tables of features."""
    made = tmp_path_factory.mktemp("inputs")
    net = Derenderer.from_preset("small", seed=0, image_size=32, width=4, light_width=4, code_size=8)
    with torch.no_grad():
        next(net.nets["geometry"].parameters()).fill_(float("nan"))
    net.save(made / "broken")
    write(faces.generate(4, 32, 0), made / "faces")
    values = np.random.default_rng(0).normal(size=(ROWS, 6))
    alone = np.array([f"person {row}" for row in range(ROWS)])
    labels = {"identity": np.array(list("abcd"))[np.arange(ROWS) % 4], "alone": alone}
    names = tuple(f"{row}.png" for row in range(ROWS))
    FeatureTable(names, {"geometry": values, "albedo": values[:, :2]}, labels).write(made / "ours.parquet")
    FeatureTable(names, {"code": values}, labels).write(made / "other.parquet")
    return made


@pytest.mark.parametrize("protocol", ["geometry", "reconstruction", "disentangle", "robustness"])
def test_a_model_that_went_wrong_is_not_scored(protocol, folder, refused):
    data = ["-d", folder / "faces"] if protocol != "robustness" else []
    printed = refused("evaluate", protocol, "-m", folder / "broken", *data, "--cache", "none")
    assert "has weights that are NaN or infinite (first nets.geometry." in printed


def test_labels_and_factors_that_ask_nothing(folder, refused):
    table = ("-f", folder / "ours.parquet", *ROOM)
    printed = refused("evaluate", "cluster", *table, "-l", "alone")
    assert "every one of the 40 labelled rows of 'alone' is a class of its own" in printed
    printed = refused("evaluate", "cluster", *table, "-l", "identity", "--factors", "geometri")
    assert "unknown factor 'geometri'; did you mean 'geometry'" in printed
    words = ("evaluate", "linear", *table, "-l", "identity")
    printed = refused(*words, "--counts", "10", "--groups", "identity")
    assert "classes tested is learned from" in printed and "these groups hold whole classes" in printed
