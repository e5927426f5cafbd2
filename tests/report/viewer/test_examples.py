"""The faces that the page begins with are such as the bundled models know."""

import numpy as np

from derender import load
from derender.evaluation.oddness import ODD_PERCENTILE, reconstruction_percentile
from derender.model import model_folder
from derender.report.viewer.examples import named_examples, rendered_examples
from derender.training.held_out_errors import read_errors


def test_rendered_faces_are_known_to_the_model_and_differ():
    examples = rendered_examples("rendered-faces-64", 64)
    stacked = np.stack([example.picture for example in examples])
    assert stacked.shape == (8, 3, 64, 64) and stacked.dtype == np.uint8
    assert len({example.name for example in examples}) == 8
    assert len({picture.tobytes() for picture in stacked}) == 8
    net, errors = load("rendered-faces-64"), read_errors(model_folder("rendered-faces-64"))
    assert errors is not None
    found = reconstruction_percentile(net, stacked, errors)
    assert (found <= ODD_PERCENTILE).all() and np.median(found) < 80


def test_other_models_and_sizes(tmp_path):
    assert rendered_examples(str(tmp_path / "faces"), 64) == []
    assert [example.picture.shape for example in rendered_examples("faces-64", 32)] == [(3, 32, 32)] * 8
    mine = np.zeros((3, 8, 8), np.uint8)
    (only,) = named_examples({tmp_path / "me.png": mine})
    assert only.name == "me.png" and only.picture is mine
