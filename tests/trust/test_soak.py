"""The verdicts of a soak: growth is called growth through the noise, and wavering is not."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))

from soak import BOUNDS, grown, measured

WAVERING = 500 + np.random.default_rng(0).normal(0, 15, 360)
RISING = np.linspace(0, 1, 360)


@pytest.mark.parametrize(
    ("values", "quantity", "grows"),
    [
        pytest.param(WAVERING, "private_mb", False, id="wavers"),
        pytest.param(WAVERING + 300 * np.minimum(4 * RISING, 1), "private_mb", False, id="warms up"),
        pytest.param(np.where(np.arange(360) == 200, 900, WAVERING), "private_mb", False, id="one peak"),
        pytest.param(WAVERING + 80 * RISING, "private_mb", True, id="leaks"),
        pytest.param(40 + np.floor(12 * RISING), "descriptors", True, id="leaks one by one"),
        pytest.param(40 + np.arange(360) % 4, "descriptors", False, id="a few more or less"),
    ],
)
def test_growth_is_found_through_the_noise_and_wavering_is_flat(values, quantity, grows):
    assert (grown(values.tolist(), BOUNDS[quantity]) > 0) is grows


def test_a_process_is_measured_and_few_samples_are_refused(tmp_path):
    (tmp_path / "one").touch()
    now = measured(tmp_path)
    assert now["files"] == 1 and now["private_mb"] > 10 and now["descriptors"] > 2 and now["threads"] >= 1
    with pytest.raises(ValueError, match="soak for longer"):
        grown([1.0], BOUNDS["files"])
