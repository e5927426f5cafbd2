"""Weights into a module, or an error that names the first one that does not fit."""

from collections.abc import Mapping

from torch import Tensor, nn


def fit_weights(module: nn.Module, weights: Mapping[str, Tensor]) -> None:
    """Load weights by name; all of them, and no others.

    Raises:
        ValueError: one is missing, has another shape, or is not the module's; names the first.
    """
    expected = module.state_dict()
    for name, value in expected.items():
        if name not in weights:
            raise ValueError(f"it has no {name!r}, which this architecture needs")
        if weights[name].shape != value.shape:
            found, wanted = tuple(weights[name].shape), tuple(value.shape)
            raise ValueError(f"{name!r} has shape {found} there and {wanted} in this architecture")
    strangers = [name for name in weights if name not in expected]
    if strangers:
        raise ValueError(f"it has {strangers[0]!r}, which this architecture lacks")
    module.load_state_dict(dict(weights))
