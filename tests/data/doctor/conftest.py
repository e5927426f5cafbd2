"""The generator of random numbers that these tests share."""

import numpy as np
import pytest


@pytest.fixture
def numbers() -> np.random.Generator:
    return np.random.default_rng(3)
