"""How closely results must agree, by dtype. A looser bound elsewhere cites the error that was measured."""

import torch
from torch import Tensor

RELATIVE = {torch.float32: 1e-5, torch.float64: 1e-10}
"""Of the largest expected magnitude: a sum of terms that cancel is as accurate as its terms."""

ABSOLUTE = {torch.float32: 1e-6, torch.float64: 1e-12}


def assert_agrees(actual: Tensor, expected: Tensor, what: str = "value") -> None:
    """Same shape and dtype, finite, and no farther apart than the table allows."""
    for name in ("shape", "dtype"):
        one, other = getattr(actual, name), getattr(expected, name)
        assert one == other, f"{what}: {name} {one}, expected {other}"
    assert actual.isfinite().all(), f"{what}: not finite"
    if expected.numel() == 0:
        return
    error = float((actual.detach() - expected.detach()).abs().max())
    bound = ABSOLUTE[actual.dtype] + RELATIVE[actual.dtype] * float(expected.detach().abs().max())
    assert error <= bound, f"{what}: differs by {error:.3g}, allowed {bound:.3g}"
