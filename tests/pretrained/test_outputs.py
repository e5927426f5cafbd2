"""The shipped models give the outputs that were recorded: codes, features, scenes, renderings, fits."""

import numpy as np
import pytest
from safetensors.numpy import load_file
from tests.pretrained import record_outputs as record

LARGEST_DIFFERENCE = 1e-5  # of the largest value of each output
OF_FEATURES = 1e-4  # rounding, other on another processor, is the gradient where an image is flat


@pytest.mark.parametrize("name", record.PICTURES)
def test_a_shipped_model_gives_its_recorded_outputs(name):
    expected = load_file(record.FOLDER / f"{name}.safetensors")
    np.testing.assert_allclose(
        record.pictures_of(name).numpy()[..., ::8, ::8], expected.pop("pictures"), atol=1e-6,
        err_msg="the generated images have changed, so nothing can be said of the model",
    )  # fmt: skip
    result = record.outputs_of(name)
    assert result.keys() == expected.keys()
    for key, value in expected.items():
        assert result[key].shape == value.shape, key
        scale = max(1.0, float(np.abs(value).max()))
        apart = float(np.abs(result[key] - value).max())
        most = OF_FEATURES if key.startswith("feature.") else LARGEST_DIFFERENCE
        assert apart <= most * scale, f"{key}: {apart:.2g} of {scale:.2g}"
