"""The images that the page begins with are such as the bundled models know."""

import numpy as np
import pytest

from derender import load
from derender.report.viewer.images import rendered_examples
from derender.storage.places import bundled_models, model_folder
from derender.training.held_out_errors import OUTLIER_PERCENTILE, read_errors, reconstruction_percentile


@pytest.mark.parametrize("model", ["faces-64", "rendered-faces-64", "cars-64"])
def test_rendered_examples_are_known_to_the_model_and_differ(model):
    examples = rendered_examples(model)
    assert [example.name for example in examples] == [f"example {number}" for number in range(1, 9)]
    assert len({example.picture.tobytes() for example in examples}) == 8
    stacked = np.stack([np.asarray(example.thumbnail(64)) for example in examples]).transpose(0, 3, 1, 2)
    net, errors = load(model), read_errors(model_folder(model))
    assert errors is not None
    result = reconstruction_percentile(net, stacked, errors)
    assert (result <= OUTLIER_PERCENTILE).all() and np.median(result) < 80


def test_every_bundled_model_has_examples_and_others_have_none(tmp_path):
    assert all(rendered_examples(name) for name in bundled_models())
    assert rendered_examples(str(tmp_path / "faces")) == []
