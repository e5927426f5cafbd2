"""Torch's global switch is as it was after a run, however the run ended."""

import pytest
import torch

from derender.training.process import deterministic_algorithms


@pytest.mark.parametrize("before", [False, True])
@pytest.mark.parametrize("wanted", [False, True])
def test_the_switch_is_turned_back(before, wanted):
    torch.use_deterministic_algorithms(before, warn_only=before)
    try:
        with pytest.raises(KeyError), deterministic_algorithms(wanted):
            assert torch.are_deterministic_algorithms_enabled() is wanted
            raise KeyError
        assert torch.are_deterministic_algorithms_enabled() is before
        assert torch.is_deterministic_algorithms_warn_only_enabled() is before
    finally:
        torch.use_deterministic_algorithms(False)
