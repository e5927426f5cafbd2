"""Gradient directions: what light changes slowly stays, a mirror image mirrors them."""

import torch

from derender.postprocess.embedding import CELLS, SCALE, gradient_directions


def images(seed=0, size=64):
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(3, 3, size // 4, size // 4, generator=generator)
    return torch.nn.functional.interpolate(coarse, size=size, mode="bicubic").clamp(0.2, 1)


def similarity(a, b):
    return torch.nn.functional.cosine_similarity(a, b, dim=1)


def test_a_slow_change_of_light_turns_them_little():
    image = images()
    dimmed = image * torch.linspace(0.3, 1, 64)
    ours = similarity(gradient_directions(image), gradient_directions(dimmed))
    pixels = similarity((image - image.mean()).flatten(1), (dimmed - dimmed.mean()).flatten(1))
    assert (ours > 0.95).all() and (ours > pixels).all()
    assert (similarity(gradient_directions(image / 2), gradient_directions(image)) > 0.99).all()


def test_a_ramp_points_where_it_rises_and_a_mirror_image_mirrors():
    ramp = torch.linspace(0, 1, 64).expand(1, 3, 64, 64)
    right, down = gradient_directions(ramp).view(2, CELLS, CELLS)
    assert (right[:, 1:-1] > 0.8 * SCALE).all() and down.abs().max() < 1e-3
    right, down = gradient_directions(images()).view(3, 2, CELLS, CELLS).unbind(1)
    mirrored, still_down = gradient_directions(images().flip(-1)).view(3, 2, CELLS, CELLS).unbind(1)
    torch.testing.assert_close(mirrored.flip(-1), -right)
    torch.testing.assert_close(still_down.flip(-1), down)
    assert gradient_directions(torch.full((1, 3, 40, 36), 0.5)).abs().max() == 0
