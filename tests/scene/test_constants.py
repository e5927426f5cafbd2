"""Numbers brought to a device once: the same tensor for the same wish, and fit for gradients."""

import torch

from derender.scene.constants import constant, kept


def test_a_constant_is_made_once_for_each_kind_and_serves_gradients():
    like = torch.zeros(2, dtype=torch.float64)
    with torch.inference_mode():
        first = constant(((0.0, 1.0), (2.0, 3.5)), like)
    assert first.tolist() == [[0, 1], [2, 3.5]] and first.dtype == torch.float64
    assert constant(((0.0, 1.0), (2.0, 3.5)), like) is first
    assert constant(((0.0, 1.0), (2.0, 3.5)), like.float()) is not first
    assert kept((1, 3), like.device, torch.int64).tolist() == [1, 3]
    factor = torch.ones(2, 2, dtype=torch.float64, requires_grad=True)
    (factor * first).sum().backward()
    assert factor.grad is not None and torch.equal(factor.grad, first)
