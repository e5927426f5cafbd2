"""The images that the page begins with are such as the bundled models know."""

import numpy as np
import pytest

from derender import load
from derender.evaluation.out_of_distribution import OUTLIER_PERCENTILE, reconstruction_percentile
from derender.report.viewer.neighbours import named_examples, rendered_examples
from derender.storage.folder import bundled_models, model_folder
from derender.training.held_out_errors import read_errors


@pytest.mark.parametrize(("model", "thing"), [("rendered-faces-64", "face"), ("cars-64", "car")])
def test_rendered_examples_are_known_to_the_model_and_differ(model, thing):
    examples = rendered_examples(model, 64)
    assert examples[0].name == f"rendered {thing} 1"
    stacked = np.stack([example.picture for example in examples]).transpose(0, 3, 1, 2)
    assert stacked.shape == (8, 3, 64, 64) and stacked.dtype == np.uint8
    assert len({example.name for example in examples}) == 8
    assert len({picture.tobytes() for picture in stacked}) == 8
    net, errors = load(model), read_errors(model_folder(model))
    assert errors is not None
    found = reconstruction_percentile(net, stacked, errors)
    assert (found <= OUTLIER_PERCENTILE).all() and np.median(found) < 80


def test_every_bundled_model_has_examples():
    assert all(rendered_examples(name, 64) for name in bundled_models())


def test_other_models_and_sizes(tmp_path):
    assert rendered_examples(str(tmp_path / "faces"), 64) == []
    assert [example.picture.shape for example in rendered_examples("faces-64", 32)] == [(32, 32, 3)] * 8
    mine = np.zeros((8, 8, 3), np.uint8)
    (only,) = named_examples({tmp_path / "me.png": mine})
    assert only.name == "me.png" and only.picture is mine
