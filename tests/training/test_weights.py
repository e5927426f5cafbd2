"""Weights fit, or the first that does not is named."""

import pytest
import torch
from torch import nn

from derender.training.checkpoint import fit_weights


def net(width: int = 3) -> nn.Module:
    return nn.Sequential(nn.Linear(2, width), nn.BatchNorm1d(width), nn.Linear(width, 1))


def test_weights_that_fit_are_taken_over_buffers_included():
    source, target = net(), net()
    source[1].running_mean += 5
    fit_weights(target, source.state_dict())
    assert all(torch.equal(value, target.state_dict()[name]) for name, value in source.state_dict().items())


def test_the_first_weight_that_does_not_fit_is_named_and_nothing_is_changed():
    target = net()
    before = {name: value.clone() for name, value in target.state_dict().items()}
    given = net().state_dict()
    for weights, message in [
        (net(4).state_dict(), r"'0\.weight' has shape \(4, 2\) there and \(3, 2\) in this architecture"),
        ({**given, "stranger": torch.zeros(1)}, "it has 'stranger', which this architecture lacks"),
        (
            {name: value for name, value in given.items() if name not in ("1.running_var", "2.bias")},
            r"it has no '1\.running_var', which this architecture needs",
        ),
    ]:
        with pytest.raises(ValueError, match=message):
            fit_weights(target, weights)
    assert all(torch.equal(value, target.state_dict()[name]) for name, value in before.items())
