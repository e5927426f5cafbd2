"""Layers, codes, styles and images of the generator: against scipy, one kernel an image, published sizes."""

import numpy as np
import pytest
import torch
from scipy import signal
from torch.nn.functional import conv2d, conv_transpose2d

from derender.baselines import generator as gan
from derender.baselines.stylegan2 import Discriminator

TAPS = torch.tensor(gan.FILTER, dtype=torch.float64)
WIDTHS = {"channel_base": 128, "channel_max": 10}
SMALL = gan.GeneratorSettings(image_size=16, style_size=12, mapping_layers=3, **WIDTHS)


def config_f(size: int) -> gan.GeneratorSettings:
    """The published networks' sizes."""
    return gan.GeneratorSettings(image_size=size, style_size=512, channel_base=32_768, channel_max=512)


@pytest.fixture
def net(seeded):
    return seeded(gan.Generator, SMALL).requires_grad_(False)


@pytest.mark.parametrize(
    ("size", "parameters", "codes", "space"), [(1024, 30_370_060, 18, 9_088), (256, 30_034_338, 14, 8_704)]
)
def test_the_published_sizes(size, parameters, codes, space):
    with torch.device("meta"):
        net, discriminator = gan.Generator(config_f(size)), Discriminator(config_f(1024))
    assert sum(value.numel() for value in net.parameters()) == parameters
    assert net.settings.codes == codes and sum(layer.channels for layer in net.layers) == space
    assert sum(value.numel() for value in discriminator.parameters()) == 29_012_513


def test_style_space_is_ordered_as_images_are_made():
    layers = gan.style_layers(config_f(1024))
    assert sum(layer.channels for layer in layers[:4]) == 2_048
    assert [layer.colour for layer in layers[:5]] == [False, True, False, False, True]
    assert [layer.resolution for layer in layers[:5]] == [4, 4, 4, 8, 8]
    assert [layer.code for layer in layers[:8]] == [0, 1, 1, 2, 3, 3, 4, 5] and layers[-1].code == 17


def test_w_its_repetition_and_its_styles_give_the_same_image(net, generator):
    w = net.random_w(3, generator)
    image, seen = net(w), []
    assert image.shape == (3, 3, 16, 16)
    assert torch.equal(image, net(w[:, None].expand(-1, SMALL.codes, -1)))
    assert torch.equal(image, net.synthesise(net.styles(net.w_plus(w)), None, seen))
    shapes = [(3, layer.channels, layer.resolution, layer.resolution) for layer in net.layers]
    assert [tuple(maps.shape) for maps in seen] == shapes
    assert torch.equal(seen[0][0], net.constant[0])
    torch.testing.assert_close(image[1:2], net(w[1:2]))
    with pytest.raises(ValueError, match="8, 16, 32"):
        gan.GeneratorSettings(image_size=48)


def test_a_code_steers_the_layers_of_its_depth(net, generator):
    first, second = (net.w_plus(net.random_w(1, generator)) for _ in range(2))
    last = SMALL.codes - 1
    mixed = torch.cat([first[:, :last], second[:, last:]], dim=1)
    pairs = enumerate(zip(net.styles(first), net.styles(mixed), strict=True))
    changed = [number for number, (one, other) in pairs if not torch.equal(one, other)]
    assert changed == [number for number, layer in enumerate(net.layers) if layer.code == last]


def scipy_upfirdn(image, taps, up, padding):
    """scipy's, along both axes, of one image padded after the zeros were put in."""
    for axis in (0, 1):
        spread = np.apply_along_axis(lambda row: signal.upfirdn([1.0], row, up=up), axis, image)
        missing = image.shape[axis] * up - spread.shape[axis]  # scipy ends at the last pixel
        widths = [(0, 0), (0, 0)]
        widths[axis] = (padding[0], padding[1] + missing)
        kernel = taps[:, None] if axis == 0 else taps[None]
        image = signal.convolve(np.pad(spread, widths), kernel, mode="valid")
    return image


@pytest.mark.parametrize(("up", "padding"), [(1, (0, 0)), (2, (2, 1)), (1, (1, 1)), (2, (4, 2)), (3, (1, 0))])
def test_upfirdn_is_scipys(up, padding, generator):
    taps = torch.tensor([0.1, 0.5, -0.2, 0.4, 0.3], dtype=torch.float64)  # not symmetric
    images = torch.randn(2, 3, 7, 10, dtype=torch.float64, generator=generator)
    result = gan.upfirdn(images, taps, up=up, padding=padding)
    for one, image in zip(result.flatten(0, 1), images.flatten(0, 1), strict=True):
        wanted = scipy_upfirdn(image.numpy(), taps.numpy(), up, padding)
        torch.testing.assert_close(one, torch.from_numpy(wanted))


def by_one_kernel_an_image(images, weight, style, demodulate, up):
    """The paper's form: weights are modulated and demodulated for each image, then convolved in groups."""
    n, inputs = images.shape[:2]
    outputs, _, kernel, _ = weight.shape
    own = weight[None] / (inputs * kernel**2) ** 0.5 * style[:, None, :, None, None]
    if demodulate:
        own = own / (own.square().sum(dim=(2, 3, 4), keepdim=True) + 1e-8).sqrt()
    flat = images.reshape(1, -1, *images.shape[2:])
    if up:
        kernels = own.transpose(1, 2).reshape(n * inputs, outputs, kernel, kernel)
        result = conv_transpose2d(flat, kernels, stride=2, groups=n)
        return gan.upfirdn(result.reshape(n, outputs, *result.shape[2:]), 2 * TAPS, padding=(1, 1))
    kernels = own.reshape(n * outputs, inputs, kernel, kernel)
    return conv2d(flat, kernels, padding=kernel // 2, groups=n).reshape(n, outputs, *images.shape[2:])


@pytest.mark.parametrize("demodulate", [True, False])
@pytest.mark.parametrize("up", [True, False])
def test_modulation_is_that_of_one_kernel_for_each_image(demodulate, up, generator):
    conv = gan.ModulatedConv(4, 7, 3, 8, demodulate=demodulate, up=up).double()
    draw = [torch.randn(shape, dtype=torch.float64, generator=generator) for shape in ((3, 4, 5, 6), (3, 4))]
    inputs = (*(value.requires_grad_() for value in draw), conv.weight)
    result, wanted = conv(*draw), by_one_kernel_an_image(draw[0], conv.weight, draw[1], demodulate, up)
    torch.testing.assert_close(result, wanted)
    cotangent = torch.randn(result.shape, dtype=torch.float64, generator=generator)
    gradients = (torch.autograd.grad(made, inputs, cotangent) for made in (result, wanted))
    for ours, theirs in zip(*gradients, strict=True):
        torch.testing.assert_close(ours, theirs)


def test_equalised_layers_keep_the_variance_whatever_their_rate(seeded, generator):
    values = torch.randn(2000, 256, generator=generator)
    for rate in (1.0, 0.01):
        layer = seeded(gan.EqualLinear, 256, 256, rate=rate, seed=1)
        assert layer.weight.var().item() == pytest.approx(1 / rate**2, rel=0.05)
        assert layer(values).var().item() == pytest.approx(1, rel=0.05)
    assert torch.equal(gan.StyledConv(64, 8, 512).affine(torch.zeros(2, 512)), torch.ones(2, 64))
