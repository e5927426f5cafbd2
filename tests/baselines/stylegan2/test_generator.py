"""Codes, styles and pictures of the generator; scores of the discriminator."""

import pytest
import torch

from derender.baselines.stylegan2.discriminator import Discriminator, group_of, with_group_deviation
from derender.baselines.stylegan2.generator import (
    Generator,
    GeneratorSettings,
    config_f,
    style_layers,
    truncate,
)

SMALL = GeneratorSettings(image_size=16, style_size=12, mapping_layers=3, channel_base=128, channel_max=10)


@pytest.fixture
def net():
    torch.manual_seed(0)
    return Generator(SMALL).requires_grad_(False)


def test_the_published_sizes():
    """Numbers of the paper's networks: parameters, codes, style space."""
    for size, parameters, codes, space in ((1024, 30_370_060, 18, 9_088), (256, 30_034_338, 14, 8_704)):
        settings = config_f(size)
        with torch.device("meta"):
            net = Generator(settings)
        assert sum(value.numel() for value in net.parameters()) == parameters
        assert settings.codes == codes
        assert codes * settings.style_size == {18: 9_216, 14: 7_168}[codes]
        assert sum(layer.channels for layer in net.layers) == space
    with torch.device("meta"):
        discriminator = Discriminator(config_f(1024))
    assert sum(value.numel() for value in discriminator.parameters()) == 29_012_513


def test_style_space_is_ordered_as_pictures_are_made():
    layers = style_layers(config_f(1024))
    assert sum(layer.channels for layer in layers[:4]) == 2_048
    assert [(layer.colour, layer.resolution) for layer in layers[:5]] == [
        (False, 4), (True, 4), (False, 4), (False, 8), (True, 8),
    ]  # fmt: skip
    assert [layer.code for layer in layers[:8]] == [0, 1, 1, 2, 3, 3, 4, 5]
    assert layers[-1].code == 17


def test_w_and_its_repetition_give_the_same_picture(net, generator):
    w = net.mapping(net.random_z(3, generator))
    picture = net(w)
    assert picture.shape == (3, 3, 16, 16)
    assert torch.equal(picture, net(w[:, None].expand(-1, SMALL.codes, -1)))
    styles = net.styles(net.w_plus(w))
    assert torch.equal(picture, net.synthesise(styles))
    assert torch.equal(picture, net.synthesise(net.split_styles(torch.cat(styles, dim=1))))


def test_pictures_do_not_see_their_neighbours(net, generator):
    w = net.mapping(net.random_z(4, generator))
    torch.testing.assert_close(net(w)[1:2], net(w[1:2]))


def test_only_the_length_of_z_is_lost(net, generator):
    z = net.random_z(4, generator)
    torch.testing.assert_close(net.mapping(5 * z), net.mapping(z), rtol=1e-4, atol=1e-5)
    assert not torch.allclose(net.mapping(-z), net.mapping(z))


def test_noise_of_strength_zero_changes_nothing(net, generator):
    w = net.mapping(net.random_z(2, generator))
    assert torch.equal(net(w, net.random_noise(2, generator)), net(w))
    for conv in net.convs:
        conv.noise_strength.fill_(0.3)
    assert torch.equal(net(w, net.fixed_noise()), net(w, net.fixed_noise()))
    assert not torch.equal(net(w, net.random_noise(2, generator)), net(w, net.random_noise(2, generator)))


def test_a_mirrored_network_makes_mirrored_pictures(net, generator):
    w = net.mapping(net.random_z(2, generator))
    picture = net(w)
    net.constant.copy_(net.constant.flip(-1))
    for conv in net.convs:
        conv.weight.copy_(conv.weight.flip(-1))
    torch.testing.assert_close(net(w), picture.flip(-1), rtol=1e-4, atol=1e-5)


def test_a_code_steers_the_layers_from_its_depth_on(net, generator):
    first, second = (net.w_plus(net.mapping(net.random_z(1, generator))) for _ in range(2))
    last = SMALL.codes - 1
    mixed = first.clone()
    mixed[:, last] = second[:, last]
    changed = [
        number
        for number, (a, b) in enumerate(zip(net.styles(first), net.styles(mixed), strict=True))
        if not torch.equal(a, b)
    ]
    assert changed == [number for number, layer in enumerate(net.layers) if layer.code == last]


def test_watching_sees_what_each_style_scales(net, generator):
    seen = {}
    styles = net.styles(net.w_plus(net.mapping(net.random_z(2, generator))))
    net.synthesise(styles, watch=seen.__setitem__)
    assert [tuple(seen[n].shape) for n in range(len(net.layers))] == [
        (2, layer.channels, layer.resolution, layer.resolution) for layer in net.layers
    ]
    assert torch.equal(seen[0][0], net.constant[0])


def test_truncation(net, generator):
    centre = net.mean_w(200, generator)
    w = net.mapping(net.random_z(3, generator))
    assert torch.equal(truncate(w, centre, 1), w)
    assert torch.equal(truncate(w, centre, 0), centre.expand(3, -1))
    near, far = (truncate(w, centre, strength) - centre for strength in (0.25, 0.5))
    torch.testing.assert_close(2 * near, far)


def test_bad_sizes_and_codes_are_named(net):
    with pytest.raises(ValueError, match="8, 16, 32"):
        GeneratorSettings(image_size=48)
    with pytest.raises(ValueError, match=r"W\+ of 6 x 12, got \(5, 12\)"):
        net.w_plus(torch.zeros(1, 5, 12))


def test_features_of_the_discriminator_do_not_see_the_batch(generator):
    torch.manual_seed(0)
    net = Discriminator(SMALL).requires_grad_(False)
    images = torch.randn(6, 3, 16, 16, generator=generator)
    assert net(images).shape == (6,)
    torch.testing.assert_close(net.describe(images)[2:3], net.describe(images[2:3]), rtol=1e-4, atol=1e-5)
    assert not torch.allclose(net(images)[:2], net(images[:2]))  # scores do: groups are compared


def test_the_deviation_map_is_that_of_the_group(generator):
    maps = torch.randn(8, 5, 3, 3, generator=generator)
    found = with_group_deviation(maps, 4)
    assert torch.equal(found[:, :5], maps)
    members = maps[[1, 3, 5, 7]]
    wanted = members.std(dim=0, correction=0).mean()
    torch.testing.assert_close(found[3, 5], wanted.expand(3, 3), rtol=1e-4, atol=1e-5)
    assert with_group_deviation(maps, 1)[:, 5].abs().max() <= 1.01e-4
    assert [group_of(count) for count in (1, 2, 3, 4, 6, 7, 32)] == [1, 2, 3, 4, 3, 1, 4]
