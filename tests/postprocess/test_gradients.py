"""Directions and histograms of gradients: what light changes slowly stays, a mirror image mirrors them."""

import pytest
import torch

from derender.postprocess.embedding import (
    CELLS,
    HISTOGRAMS,
    ORIENTATIONS,
    SCALE,
    gradient_directions,
    gradient_histograms,
)
from derender.postprocess.embedding import HISTOGRAM_CELLS as SIDE


def images(seed=0, size=64):
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(3, 3, size // 4, size // 4, generator=generator)
    return torch.nn.functional.interpolate(coarse, size=size, mode="bicubic").clamp(0.2, 1)


def similarity(a, b):
    return torch.nn.functional.cosine_similarity(a, b, dim=1)


@pytest.mark.parametrize("describe", [gradient_directions, gradient_histograms])
def test_a_slow_change_of_light_turns_them_little(describe):
    image = images()
    dimmed = image * torch.linspace(0.3, 1, 64)
    ours = similarity(describe(image), describe(dimmed))
    pixels = similarity((image - image.mean()).flatten(1), (dimmed - dimmed.mean()).flatten(1))
    assert (ours > 0.94).all() and (ours > pixels).all()
    assert (similarity(describe(image / 2), describe(image)) > 0.99).all()


def test_a_ramp_points_where_it_rises_and_a_mirror_image_mirrors():
    ramp = torch.linspace(0, 1, 64).expand(1, 3, 64, 64)
    right, down = gradient_directions(ramp).view(2, CELLS, CELLS)
    assert (right[:, 1:-1] > 0.8 * SCALE).all() and down.abs().max() < 1e-3
    right, down = gradient_directions(images()).view(3, 2, CELLS, CELLS).unbind(1)
    mirrored, still_down = gradient_directions(images().flip(-1)).view(3, 2, CELLS, CELLS).unbind(1)
    torch.testing.assert_close(mirrored.flip(-1), -right)
    torch.testing.assert_close(still_down.flip(-1), down)
    assert gradient_directions(torch.full((1, 3, 40, 36), 0.5)).abs().max() == 0


def test_histograms_hold_the_orientation_of_an_edge_and_do_not_change_where_it_is_dark():
    across = torch.arange(64.0).view(-1, 1) + torch.zeros(64)
    stripes = 0.5 + 0.4 * torch.sin(torch.stack([across, across.T]) / 2)[:, None].expand(2, 3, 64, 64)
    found = gradient_histograms(stripes).view(2, ORIENTATIONS, SIDE, SIDE)
    assert found.sum(dim=(2, 3)).argmax(dim=1).tolist() == [ORIENTATIONS // 2, 0]  # down; right
    assert found.amin() >= 0 and found.amax() <= 0.4 + 1e-6
    halved = images()
    halved[..., 32:] *= 0.2
    inside = [gradient_histograms(one).view(3, -1, SIDE, SIDE)[..., -2:] for one in (images(), halved)]
    torch.testing.assert_close(inside[1], inside[0], atol=0.01, rtol=0)
    assert not gradient_histograms(torch.full((1, 3, 40, 36), 0.5)).isnan().any()


def test_a_mirror_image_mirrors_histograms():
    found, mirrored = (gradient_histograms(one).view(3, ORIENTATIONS, SIDE, SIDE) for one in (
        images(), images().flip(-1)
    ))  # fmt: skip
    assert found[0].numel() == HISTOGRAMS
    turned = mirrored.flip(-1)[:, [0, *range(ORIENTATIONS - 1, 0, -1)]]
    torch.testing.assert_close(turned, found, atol=1e-4, rtol=1e-4)
