"""Layers that do less work give what the plain layers give: outputs and every gradient."""

import pytest
import torch
from tests.tolerances import assert_agrees
from torch.nn import functional

from derender.networks.decoders import NarrowConv2d, UpsampledConv2d
from derender.networks.encoders import NormReLU

DTYPES = (torch.float32, torch.float64)


def gradients(output, inputs, generator):
    cotangent = torch.randn(output.shape, generator=generator, dtype=output.dtype)
    return torch.autograd.grad(output, inputs, cotangent)


def leaf(shape, generator, dtype, *, channels_last=True):
    value = torch.randn(shape, generator=generator, dtype=dtype)
    if len(shape) == 4 and channels_last:
        value = value.contiguous(memory_format=torch.channels_last)
    return value.requires_grad_()


def assert_same(actual, expected, inputs, generator):
    """Outputs, and the gradient of every input."""
    assert_agrees(actual, expected)
    seed = generator.get_state()
    found = gradients(actual, inputs, generator)
    wanted = gradients(expected, inputs, generator.set_state(seed))
    for index, (a, b) in enumerate(zip(found, wanted, strict=True)):
        assert_agrees(a, b, f"gradient of input {index}")


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("height", "width"), [(4, 4), (5, 3), (1, 7)])
def test_one_transposed_convolution_is_doubling_then_convolution(height, width, dtype, generator):
    layer = UpsampledConv2d(3, 5).to(dtype)
    values = leaf((2, 3, height, width), generator, dtype)
    expected = functional.conv2d(functional.interpolate(values, scale_factor=2), layer.weight, padding=1)
    assert_same(layer(values), expected, (values, layer.weight), generator)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("channels", [1, 2, 3])
@pytest.mark.parametrize(("height", "width"), [(4, 8), (16, 12)])
def test_convolution_by_blocks_is_the_plain_convolution(height, width, channels, dtype, generator):
    layer = NarrowConv2d(6, channels).to(dtype)
    values = leaf((2, 6, height, width), generator, dtype)
    expected = functional.conv2d(values, layer.weight, padding=2)
    assert_same(layer(values), expected, (values, layer.weight), generator)


@pytest.mark.parametrize("slope", [0.0, 0.2])
def test_normalisation_is_of_four_channels_a_group_and_then_rectified(slope, generator):
    values = leaf((2, 8, 5, 7), generator, torch.float64)
    groups = values.reshape(2, 2, -1)
    deviation, mean = torch.var_mean(groups, dim=2, correction=0, keepdim=True)
    expected = functional.leaky_relu((groups - mean) / (deviation + 1e-5).sqrt(), slope)
    assert_agrees(NormReLU(8, slope).double()(values), expected.reshape(2, 8, 5, 7))
