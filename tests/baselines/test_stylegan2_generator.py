"""Layers, codes, styles and images of the generator: against scipy, one kernel an image, published sizes."""

import numpy as np
import pytest
import torch
from scipy import signal
from torch.nn.functional import conv2d, conv_transpose2d

from derender.baselines.stylegan2 import Discriminator, EqualConv, Stylegan, with_group_deviation
from derender.baselines.stylegan2_generator import (
    FILTER,
    EqualLinear,
    Generator,
    GeneratorSettings,
    ModulatedConv,
    StyledConv,
    modulated_conv,
    style_layers,
    upfirdn,
)

TAPS = torch.tensor(FILTER, dtype=torch.float64)


def config_f(size: int) -> GeneratorSettings:
    """The published networks' sizes."""
    return GeneratorSettings(image_size=size, style_size=512, channel_base=32_768, channel_max=512)


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
    w = net.random_w(3, generator)
    picture = net(w)
    assert picture.shape == (3, 3, 16, 16)
    assert torch.equal(picture, net(w[:, None].expand(-1, SMALL.codes, -1)))
    styles = net.styles(net.w_plus(w))
    assert torch.equal(picture, net.synthesise(styles))
    assert torch.equal(picture, net.synthesise(net.split_styles(torch.cat(styles, dim=1))))


def test_pictures_do_not_see_their_neighbours(net, generator):
    w = net.random_w(4, generator)
    torch.testing.assert_close(net(w)[1:2], net(w[1:2]))


def test_only_the_length_of_z_is_lost(net, generator):
    z = torch.randn(4, 12, generator=generator)
    torch.testing.assert_close(net.mapping(5 * z), net.mapping(z), rtol=1e-4, atol=1e-5)
    assert not torch.allclose(net.mapping(-z), net.mapping(z))


def test_noise_of_strength_zero_changes_nothing(net, generator):
    w = net.random_w(2, generator)
    assert torch.equal(net(w, net.random_noise(2, generator)), net(w))
    for conv in net.convs:
        conv.noise_strength.fill_(0.3)
    assert torch.equal(net(w, net.fixed_noise()), net(w, net.fixed_noise()))
    assert not torch.equal(net(w, net.random_noise(2, generator)), net(w, net.random_noise(2, generator)))


def test_a_mirrored_network_makes_mirrored_pictures(net, generator):
    w = net.random_w(2, generator)
    picture = net(w)
    net.constant.copy_(net.constant.flip(-1))
    for conv in net.convs:
        conv.weight.copy_(conv.weight.flip(-1))
    torch.testing.assert_close(net(w), picture.flip(-1), rtol=1e-4, atol=1e-5)


def test_a_code_steers_the_layers_from_its_depth_on(net, generator):
    first, second = (net.w_plus(net.random_w(1, generator)) for _ in range(2))
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
    styles = net.styles(net.w_plus(net.random_w(2, generator)))
    net.synthesise(styles, watch=seen.__setitem__)
    assert [tuple(seen[n].shape) for n in range(len(net.layers))] == [
        (2, layer.channels, layer.resolution, layer.resolution) for layer in net.layers
    ]
    assert torch.equal(seen[0][0], net.constant[0])


def test_truncation(generator):
    torch.manual_seed(0)
    model = Stylegan(SMALL)
    whole, half, none = (
        model.sample(3, torch.Generator().manual_seed(1), truncation=strength) for strength in (1.0, 0.5, 0.0)
    )
    torch.testing.assert_close(none, none[:1].expand_as(none))
    assert (half - none).abs().mean() < (whole - none).abs().mean()


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


def scipy_upfirdn(picture, taps, up, padding):
    """scipy's, along both axes, of one image padded after the zeros were put in."""
    for axis in (0, 1):
        spread = np.apply_along_axis(lambda row: signal.upfirdn([1.0], row, up=up), axis, picture)
        missing = picture.shape[axis] * up - spread.shape[axis]  # scipy ends at the last pixel
        widths = [(0, 0), (0, 0)]
        widths[axis] = (padding[0], padding[1] + missing)
        picture = signal.convolve(
            np.pad(spread, widths), taps[:, None] if axis == 0 else taps[None], mode="valid"
        )
    return picture


@pytest.mark.parametrize(
    ("up", "padding"),
    [(1, (0, 0)), (2, (2, 1)), (1, (1, 1)), (2, (4, 2)), (3, (1, 0))],
)
def test_upfirdn_is_scipys(up, padding, generator):
    taps = torch.tensor([0.1, 0.5, -0.2, 0.4, 0.3], dtype=torch.float64)  # not symmetric
    images = torch.randn(2, 3, 7, 10, dtype=torch.float64, generator=generator)
    found = upfirdn(images, taps, up=up, padding=padding)
    for picture in range(2):
        for channel in range(3):
            wanted = scipy_upfirdn(images[picture, channel].numpy(), taps.numpy(), up, padding)
            torch.testing.assert_close(found[picture, channel], torch.from_numpy(wanted))


def test_upfirdn_cuts_where_the_padding_is_negative(generator):
    images = torch.randn(1, 1, 6, 9, dtype=torch.float64, generator=generator)
    taps = torch.ones(1, dtype=torch.float64)
    assert torch.equal(upfirdn(images, taps, padding=(-2, -1)), images[:, :, 2:-1, 2:-1])


def test_the_filter_keeps_brightness_and_mirrors(generator):
    assert TAPS.sum() == 1
    flat = torch.full((1, 1, 8, 8), 0.7, dtype=torch.float64)
    twice = upfirdn(flat, 2 * TAPS, up=2, padding=(2, 1))
    assert twice.shape == (1, 1, 16, 16)
    torch.testing.assert_close(twice[..., 2:-2, 2:-2], torch.full((1, 1, 12, 12), 0.7, dtype=torch.float64))
    images = torch.randn(1, 2, 6, 8, dtype=torch.float64, generator=generator)
    own, mirrored = (upfirdn(x, TAPS, up=2, padding=(2, 1)) for x in (images, images.flip(-1)))
    torch.testing.assert_close(mirrored, own.flip(-1))


def by_one_kernel_a_picture(images, weight, style, demodulate, up):
    """The paper's form: weights are modulated and demodulated for each image, then convolved in groups."""
    n, inputs = images.shape[:2]
    outputs, _, kernel, _ = weight.shape
    own = weight[None] / (inputs * kernel**2) ** 0.5 * style[:, None, :, None, None]
    if demodulate:
        own = own / (own.square().sum(dim=(2, 3, 4), keepdim=True) + 1e-8).sqrt()
    if not up:
        kernels = own.reshape(n * outputs, inputs, kernel, kernel)
        found = conv2d(images.reshape(1, -1, *images.shape[2:]), kernels, padding=kernel // 2, groups=n)
        return found.reshape(n, outputs, *found.shape[2:])
    kernels = own.transpose(1, 2).reshape(n * inputs, outputs, kernel, kernel)
    found = conv_transpose2d(images.reshape(1, -1, *images.shape[2:]), kernels, stride=2, groups=n)
    return upfirdn(found.reshape(n, outputs, *found.shape[2:]), 2 * TAPS, padding=(1, 1))


@pytest.mark.parametrize("demodulate", [True, False])
@pytest.mark.parametrize("up", [True, False])
def test_modulation_is_that_of_one_kernel_for_each_picture(demodulate, up, generator):
    draw = lambda *shape: torch.randn(  # noqa: E731
        shape, dtype=torch.float64, generator=generator
    ).requires_grad_()
    images, weight, style = draw(3, 4, 5, 6), draw(7, 4, 3, 3), draw(3, 4)
    found = modulated_conv(images, weight, style, demodulate=demodulate, taps=TAPS if up else None)
    wanted = by_one_kernel_a_picture(images, weight, style, demodulate, up)
    torch.testing.assert_close(found, wanted)
    cotangent = torch.randn(found.shape, dtype=torch.float64, generator=generator)
    inputs = (images, weight, style)
    for ours, theirs in zip(
        torch.autograd.grad(found, inputs, cotangent),
        torch.autograd.grad(wanted, inputs, cotangent),
        strict=True,
    ):
        torch.testing.assert_close(ours, theirs)


def test_demodulation_forgets_the_length_of_a_style(generator):
    images, weight = (
        torch.randn(2, 8, 6, 6, generator=generator),
        torch.randn(5, 8, 3, 3, generator=generator),
    )
    style = torch.randn(2, 8, generator=generator)
    found = [modulated_conv(images, weight, scale * style, demodulate=True) for scale in (1, 37)]
    torch.testing.assert_close(found[0], found[1], rtol=1e-4, atol=1e-5)
    plain = [modulated_conv(images, weight, scale * style, demodulate=False) for scale in (1, 37)]
    torch.testing.assert_close(37 * plain[0], plain[1], rtol=1e-4, atol=1e-3)


def test_demodulated_outputs_have_variance_one(generator):
    images = torch.randn(4, 64, 32, 32, generator=generator)
    weight = 5 * torch.randn(32, 64, 3, 3, generator=generator)
    style = torch.rand(4, 64, generator=generator) * 10
    inner = modulated_conv(images, weight, style, demodulate=True)[..., 1:-1, 1:-1]
    assert inner.var().item() == pytest.approx(1, abs=0.05)
    assert modulated_conv(images, weight, style, demodulate=False).var().item() > 100


def test_equalised_layers_keep_the_variance_whatever_their_rate(generator):
    torch.manual_seed(1)  # not the generator's seed: its numbers would be those of the weights
    values = torch.randn(2000, 256, generator=generator)
    for rate in (1.0, 0.01):
        layer = EqualLinear(256, 256, rate=rate)
        assert layer.weight.var().item() == pytest.approx(1 / rate**2, rel=0.05)
        assert layer(values).var().item() == pytest.approx(1, rel=0.05)
    conv = EqualConv(32, 32, 3, active=False)
    assert conv(torch.randn(4, 32, 20, 20, generator=generator))[
        ..., 1:-1, 1:-1
    ].var().item() == pytest.approx(1, rel=0.1)


def test_noise_counts_only_with_its_strength(generator):
    layer = StyledConv(4, 6, 8)
    images, style = torch.randn(2, 4, 8, 8, generator=generator), torch.ones(2, 4)
    first, second = (torch.randn(2, 1, 8, 8, generator=generator) for _ in range(2))
    assert torch.equal(layer(images, style, first), layer(images, style, second))
    assert torch.equal(layer(images, style, first), layer(images, style))
    with torch.no_grad():
        layer.noise_strength.fill_(0.5)
    assert not torch.equal(layer(images, style, first), layer(images, style, second))


def test_a_fresh_affine_map_gives_styles_about_one(generator):
    torch.manual_seed(0)
    layer = ModulatedConv(64, 8, 3, 512, demodulate=True, up=False)
    style = layer.affine(torch.zeros(2, 512))
    assert torch.equal(style, torch.ones(2, 64))
