"""Resampling against scipy, modulation against a kernel for each picture, and what both leave unchanged."""

import numpy as np
import pytest
import torch
from scipy import signal
from torch.nn.functional import conv2d, conv_transpose2d

from derender.baselines.stylegan2.layers import (
    FILTER,
    EqualConv,
    EqualLinear,
    ModulatedConv,
    StyledConv,
    modulated_conv,
    pixel_norm,
    upfirdn,
    upsample,
)

TAPS = torch.tensor(FILTER, dtype=torch.float64)


def scipy_upfirdn(picture, taps, up, down, padding):
    """scipy's, along both axes, of one picture padded after the zeros were put in."""
    for axis in (0, 1):
        spread = np.apply_along_axis(lambda row: signal.upfirdn([1.0], row, up=up), axis, picture)
        missing = picture.shape[axis] * up - spread.shape[axis]  # scipy ends at the last pixel
        widths = [(0, 0), (0, 0)]
        widths[axis] = (padding[0], padding[1] + missing)
        full = signal.convolve(
            np.pad(spread, widths), taps[:, None] if axis == 0 else taps[None], mode="valid"
        )
        picture = full[::down] if axis == 0 else full[:, ::down]
    return picture


@pytest.mark.parametrize(
    ("up", "down", "padding"),
    [(1, 1, (0, 0)), (2, 1, (2, 1)), (1, 2, (1, 1)), (2, 3, (4, 2)), (3, 2, (1, 0))],
)
def test_upfirdn_is_scipys(up, down, padding, generator):
    taps = torch.tensor([0.1, 0.5, -0.2, 0.4, 0.3], dtype=torch.float64)  # not symmetric
    images = torch.randn(2, 3, 7, 10, dtype=torch.float64, generator=generator)
    found = upfirdn(images, taps, up=up, down=down, padding=padding)
    for picture in range(2):
        for channel in range(3):
            wanted = scipy_upfirdn(images[picture, channel].numpy(), taps.numpy(), up, down, padding)
            torch.testing.assert_close(found[picture, channel], torch.from_numpy(wanted))


def test_upfirdn_cuts_where_the_padding_is_negative(generator):
    images = torch.randn(1, 1, 6, 9, dtype=torch.float64, generator=generator)
    taps = torch.ones(1, dtype=torch.float64)
    assert torch.equal(upfirdn(images, taps, padding=(-2, -1)), images[:, :, 2:-1, 2:-1])


def test_the_filter_keeps_brightness():
    assert TAPS.sum() == 1
    flat = torch.full((1, 1, 8, 8), 0.7, dtype=torch.float64)
    twice = upsample(flat, TAPS)
    assert twice.shape == (1, 1, 16, 16)
    torch.testing.assert_close(twice[..., 2:-2, 2:-2], torch.full((1, 1, 12, 12), 0.7, dtype=torch.float64))
    halved = upfirdn(flat, TAPS, down=2, padding=(1, 1))
    assert halved.shape == (1, 1, 4, 4)
    torch.testing.assert_close(halved[..., 1:-1, 1:-1], torch.full((1, 1, 2, 2), 0.7, dtype=torch.float64))


def test_resampling_of_a_mirrored_picture_is_mirrored(generator):
    images = torch.randn(1, 2, 6, 8, dtype=torch.float64, generator=generator)
    torch.testing.assert_close(upsample(images.flip(-1), TAPS), upsample(images, TAPS).flip(-1))
    half = [upfirdn(x, TAPS, down=2, padding=(1, 1)) for x in (images.flip(-1), images)]
    torch.testing.assert_close(half[0], half[1].flip(-1))


def by_one_kernel_a_picture(images, weight, style, demodulate, up):
    """The paper's form: weights are modulated and demodulated for each picture, then convolved in groups."""
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


def test_pixel_norm_leaves_directions_of_length_one(generator):
    values = 7 * torch.randn(5, 64, generator=generator)
    found = pixel_norm(values)
    torch.testing.assert_close(found.square().mean(dim=1), torch.ones(5))
    torch.testing.assert_close(pixel_norm(3 * values), found)


def test_noise_counts_only_with_its_strength(generator):
    layer = StyledConv(4, 6, 8, resample="none")
    images, style = torch.randn(2, 4, 8, 8, generator=generator), torch.ones(2, 4)
    first, second = (torch.randn(2, 1, 8, 8, generator=generator) for _ in range(2))
    assert torch.equal(layer(images, style, first), layer(images, style, second))
    assert torch.equal(layer(images, style, first), layer(images, style))
    with torch.no_grad():
        layer.noise_strength.fill_(0.5)
    assert not torch.equal(layer(images, style, first), layer(images, style, second))


def test_a_fresh_affine_map_gives_styles_about_one(generator):
    torch.manual_seed(0)
    layer = ModulatedConv(64, 8, 3, 512)
    style = layer.affine(torch.zeros(2, 512))
    assert torch.equal(style, torch.ones(2, 64))
