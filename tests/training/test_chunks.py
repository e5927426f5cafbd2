"""A batch in chunks: the losses and gradients of the whole batch, for less memory."""

from functools import partial

import pytest
import torch
from torch import nn

from derender.model import Derenderer
from derender.objectives.self_features import SelfFeatures
from derender.render import render_scene
from derender.training.config import ObjectiveSettings, resolve
from derender.training.step import training_step

OBJECTIVE = ObjectiveSettings(loocc="all", cycle_weight=1.0, smoothness_weight=0.1)
FEATURES = SelfFeatures((4, 8, 8))


@pytest.fixture
def exactly(monkeypatch):
    """The whole step in float64, where rounding cannot hide a difference."""
    monkeypatch.setattr(torch.Tensor, "float", torch.Tensor.double)
    settings = resolve("small", ["image_size=32", "width=8", "light_width=4"]).model
    return Derenderer.seeded(settings, 0, renderer=partial(render_scene, backend="reference")).double()


def losses_and_gradients(model: nn.Module, images: torch.Tensor, own: float, chunks: int):
    model.zero_grad(set_to_none=True)
    noise = torch.Generator().manual_seed(3)
    result = training_step(model, images, OBJECTIVE, FEATURES.double(), noise, own=own, chunks=chunks)
    result.total.backward()
    return result.terms, {name: p.grad for name, p in model.named_parameters() if p.grad is not None}


@pytest.mark.parametrize("own", [1.0, 0.3])
def test_a_batch_in_chunks_has_the_losses_and_gradients_of_the_whole(exactly, generator, own):
    images = torch.rand(6, 3, 32, 32, generator=generator, dtype=torch.float64)
    terms, gradients = losses_and_gradients(exactly, images, own, 1)
    assert {"perceptual", "perceptual_flip", "loocc", "cycle", "l1"} <= terms.keys()
    for chunks in (3, 4):
        in_parts, same = losses_and_gradients(exactly, images, own, chunks)
        assert in_parts.keys() == terms.keys()
        for name in terms:
            torch.testing.assert_close(in_parts[name], terms[name], rtol=1e-10, atol=1e-14, msg=name)
        assert same.keys() == gradients.keys()
        for name, gradient in gradients.items():
            scale = gradient.abs().max().clamp(min=1e-12)
            assert (same[name] - gradient).abs().max() <= 1e-9 * scale, name
