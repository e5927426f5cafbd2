"""Is an image out-of-distribution for a model? Its reconstruction error among those of held-out images.

A high percentile is a sign of another kind of object, another crop or a broken image. A low one proves
nothing: a plain surface may be easy to render whatever it shows.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from derender.training.held_out_errors import HeldOutErrors, reconstruction_errors

OUTLIER_PERCENTILE = 99.0
"""Images above it are called out-of-distribution."""


def reconstruction_percentile(
    model: Any, images: UInt8[np.ndarray, "n 3 h w"], held_out: HeldOutErrors
) -> Float[np.ndarray, " n"]:
    """Percentage (0..100) of the held-out images that the model reconstructs better than each of these.

    Images like the training data have every percentile equally often. Between stored quantiles it is
    interpolated; an image into which the model renders nothing has 100. ``held_out`` is stored with the
    model (``training/held_out_errors.py``).
    """
    return percentile_of(reconstruction_errors(model, images), held_out)


def percentile_of(errors: Float[np.ndarray, " n"], held_out: HeldOutErrors) -> Float[np.ndarray, " n"]:
    """Where errors lie among the held-out ones, 0..100."""
    return np.interp(errors, held_out.quantiles, np.linspace(0, 100, len(held_out.quantiles)))
