"""Layers that do less work give what the plain layers give: outputs and every gradient."""

import pytest
import torch
from tests.tolerances import assert_agrees
from torch import nn
from torch.nn import functional

from derender.networks import norm_relu
from derender.networks.decoders import NarrowConv2d, UpsampledConv2d
from derender.networks.norm_relu import EPSILON, NormReLU, fast, reference

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


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("slope", [0.0, 0.2])
@pytest.mark.parametrize("shape", [(1, 4, 1, 1), (3, 8, 5, 7), (2, 12, 16, 16)])
def test_numba_normalisation_agrees_with_torchs(shape, slope, dtype, generator):
    values = leaf(shape, generator, dtype)
    weight, bias = leaf((shape[1],), generator, dtype), leaf((shape[1],), generator, dtype)
    groups = shape[1] // 4
    actual = fast(values, weight, bias, groups, slope, EPSILON)
    expected = reference(values, weight, bias, groups, slope, EPSILON)
    assert_same(actual, expected, (values, weight, bias), generator)


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")  # torch 2.15's own
def test_numba_normalisation_passes_gradcheck_and_opcheck(generator):
    values = leaf((2, 8, 3, 2), generator, torch.float64)
    weight, bias = leaf((8,), generator, torch.float64), leaf((8,), generator, torch.float64)
    assert torch.autograd.gradcheck(lambda *inputs: fast(*inputs, 2, 0.2, EPSILON), (values, weight, bias))
    torch.library.opcheck(norm_relu._forward, (values, weight, bias, 2, 0.2, EPSILON))


def test_pictures_far_from_zero_are_normalised_as_exactly(generator):
    """A mean a thousand deviations from zero: the one-pass variance must not cancel."""
    values = (1000 + leaf((2, 8, 32, 32), generator, torch.float32).detach()).contiguous(
        memory_format=torch.channels_last
    )
    weight, bias = torch.ones(8), torch.zeros(8)
    result = fast(values, weight, bias, 2, 0.0, EPSILON)
    exact = functional.relu(functional.group_norm(values.double(), 2))
    # float32 images near 1000 are themselves rounded to 6e-5, and scale and shift are float32
    assert (result.double() - exact).abs().max() < 5e-4


@pytest.mark.parametrize(
    ("change", "taken"),
    [
        (lambda values: values, True),
        (lambda values: values.double(), True),
        (lambda values: values.contiguous(), False),
        (lambda values: values.bfloat16(), False),
        (lambda values: values[:1], False),
    ],
    ids=["large", "float64", "other layout", "bfloat16", "small"],
)
def test_the_input_decides_who_normalises(change, taken, generator):
    values = change(leaf((8, 8, 64, 64), generator, torch.float32).detach())
    layer = NormReLU(8, 2)
    if values.dtype == torch.float64:
        layer.double()
    assert norm_relu.suits_fast(values, layer.weight) is taken
    plain = nn.Sequential(nn.GroupNorm(2, 8), nn.ReLU())
    tolerance = 3e-2 if values.dtype == torch.bfloat16 else 1e-5
    torch.testing.assert_close(layer(values).float(), plain(values.float()), atol=tolerance, rtol=tolerance)
