"""How odd a picture is to a model: its reconstruction error among those of held-out training pictures.

The percentile says how much worse a picture is rendered again than what the model was made for. A high one is
a sign of another kind of thing, another crop or a broken picture. A low one is none of the opposite: a plain
surface may be easy to render whatever it shows. Leaves out what makes the picture odd.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from derender.training.held_out_errors import HeldOutErrors, reconstruction_errors

ODD_PERCENTILE = 99.0


def reconstruction_percentile(
    model: Any,
    images: UInt8[np.ndarray, "n 3 h w"],
    held_out: HeldOutErrors,
    *,
    batch_size: int = 64,
) -> Float[np.ndarray, " n"]:
    """Percentage (0..100) of the held-out pictures that the model renders again better than each of these.

    Pictures like the training data have every percentile equally often; above 99 lies one in a hundred of
    them. Between stored quantiles it is interpolated; a picture the model renders nothing into has 100.

    Args:
        model: with ``reconstruct``, ``device`` and ``image_size``.
        images: pictures at the model's image size.
        held_out: what was kept with the model (``training/held_out_errors.py``).
        batch_size: pictures at a time; changes speed and memory only.
    """
    errors = reconstruction_errors(model, images, batch_size)
    return percentile_of(errors, held_out)


def percentile_of(errors: Float[np.ndarray, " n"], held_out: HeldOutErrors) -> Float[np.ndarray, " n"]:
    """Where errors lie among the held-out ones, 0..100."""
    percents = np.linspace(0, 100, len(held_out.quantiles))
    return np.interp(errors, held_out.quantiles, percents)
