"""The linear model of maps: what it was made of comes back, in standard deviations, mirrored and plain."""

import pytest
import torch

from derender.postprocess.fitting import MorphableMaps


def planted(count: int = 60) -> tuple[torch.Tensor, torch.Tensor]:
    """Maps of three symmetric patterns in known amounts, and the amounts."""
    draw = torch.Generator().manual_seed(0)
    patterns = torch.linalg.qr(torch.randn(48, 3, generator=draw))[0].T.reshape(3, 8, 6)
    patterns = torch.cat([patterns, patterns.flip(-1)], dim=-1)  # as their mirror images
    amounts = torch.randn(count, 3, generator=draw) * torch.tensor([3.0, 2.0, 1.0])
    return 5 + torch.einsum("nk,kyx->nyx", amounts, patterns), amounts


def test_maps_come_back_and_coordinates_are_standard_deviations():
    maps, amounts = planted()
    model = MorphableMaps.of({"depth": maps}, 3)
    result = model.coordinates("depth", maps)
    torch.testing.assert_close(model.maps("depth", result), maps, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(result.mean(0), torch.zeros(3), rtol=0, atol=1e-4)
    torch.testing.assert_close(result.square().mean(0), torch.ones(3), rtol=1e-3, atol=0)
    lengths = model.get_buffer("depth_axes").flatten(1).norm(dim=1)
    assert (lengths[:-1] >= lengths[1:]).all()
    spread = (amounts - amounts.mean(0)).square().sum() / len(maps) * 2  # a pattern stands there twice
    torch.testing.assert_close(lengths.square().sum(), spread, rtol=1e-3, atol=0)


def test_maps_are_symmetric_whatever_the_examples_were():
    maps = torch.randn(12, 3, 5, 5, generator=torch.Generator().manual_seed(1))
    model = MorphableMaps.of({"albedo": maps}, 6)
    made = model.maps("albedo", torch.randn(4, 6, generator=torch.Generator().manual_seed(2)))
    torch.testing.assert_close(made, made.flip(-1))
    one, other = model.coordinates("albedo", maps), model.coordinates("albedo", maps.flip(-1))
    torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("shape", [(4, 30, 30), (40, 4, 4)])  # fewer examples than numbers, and more
def test_no_more_coordinates_than_can_be_told(shape):
    maps = torch.rand(shape, generator=torch.Generator().manual_seed(2))
    model = MorphableMaps.of({"depth": maps}, 1_000)
    assert model.size("depth") == min(shape[0] - 1, shape[1] * shape[2])
    result = model.coordinates("depth", maps)
    torch.testing.assert_close(model.maps("depth", result), (maps + maps.flip(-1)) / 2, rtol=1e-3, atol=1e-4)


def test_examples_that_are_all_the_same_have_coordinates_of_0():
    maps = torch.full((5, 4, 4), 0.7)
    model = MorphableMaps.of({"depth": maps}, 3)
    assert torch.equal(model.coordinates("depth", maps + 1), torch.zeros(5, model.size("depth")))
    torch.testing.assert_close(model.maps("depth", torch.ones(2, model.size("depth"))), maps[:2])


def test_one_example_and_axes_of_another_shape_are_refused():
    with pytest.raises(ValueError, match="2 examples or more, got 1"):
        MorphableMaps.of({"depth": torch.zeros(1, 4, 4)}, 2)
    with pytest.raises(ValueError, match="depth: axes of"):
        MorphableMaps({"depth": torch.zeros(4, 4)}, {"depth": torch.zeros(2, 4, 5)})
