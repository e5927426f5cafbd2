"""Networks: the paper's parameter counts, every image size, bounded outputs; layers that do less work."""

import pytest
import torch
from tests.tolerances import assert_agrees
from torch.nn import functional

from derender.model import Derenderer
from derender.networks import FACTORS, NetworkSettings
from derender.networks.decoders import NarrowConv2d, UpsampledConv2d
from derender.networks.encoders import IMAGE_SIZES, NormReLU, UNetEncoder

PAPER_PARAMETERS = {"geometry": 12_979_648, "albedo": 12_982_848, "confidence": 7_678_208}
PAPER_PARAMETERS |= {"light": 1_739_264, "camera": 1_739_776}


@pytest.fixture(scope="module")
def paper() -> Derenderer:
    return Derenderer.from_preset("paper")


def test_paper_networks_have_the_papers_parameter_counts(paper):
    learnt = {name: [p for p in net.parameters() if p.requires_grad] for name, net in paper.nets.items()}
    assert {name: sum(one.numel() for one in values) for name, values in learnt.items()} == PAPER_PARAMETERS


def multiplications(model: Derenderer) -> int:
    """Multiplications of one image decomposed, counted at every convolution and linear layer."""
    counted = 0

    def count(layer, inputs, output):
        nonlocal counted
        places = inputs[0] if isinstance(layer, torch.nn.ConvTranspose2d) else output
        counted += layer.weight.numel() * (places.shape[-1] * places.shape[-2] if places.ndim == 4 else 1)

    for layer in model.modules():
        if isinstance(layer, torch.nn.Conv2d | torch.nn.ConvTranspose2d | torch.nn.Linear):
            layer.register_forward_hook(count)
    images = torch.zeros(1, 3, model.image_size, model.image_size)
    model.decompose(images)
    model.confidence(images)
    return counted


def test_small_does_about_a_sixteenth_of_the_work(paper):
    assert 13 < multiplications(paper) / multiplications(Derenderer.from_preset("small")) < 17


@pytest.mark.parametrize("size", IMAGE_SIZES)
@pytest.mark.parametrize("encoder", ["conv", "unet"])
def test_every_picture_size_gives_maps_and_codes_of_the_right_shape(size, encoder):
    model = Derenderer.from_preset("small", image_size=size, encoder=encoder, width=8, unet_width=4).eval()
    images = torch.rand(2, 3, size, size)
    codes = model.embed(images)
    assert {name: tuple(code.shape) for name, code in codes.items()} == {f.name: (2, 256) for f in FACTORS}
    scene = model.decode(codes)
    assert scene.depth.shape == (2, size, size)
    assert scene.albedo.shape == (2, 3, size, size)
    confidence = model.confidence(100 * images)
    assert all(bool((value > 0).all()) for value in vars(confidence).values())
    assert confidence.photometric.shape == confidence.photometric_flip.shape == (2, 1, size, size)
    assert confidence.perceptual.shape == confidence.perceptual_flip.shape == (2, 1, size // 4, size // 4)


def test_unet_encoder_follows_the_papers_widths_and_offers_skips():
    encoder = UNetEncoder(NetworkSettings(encoder="unet"), 256).eval()
    skips = encoder.skips(torch.rand(1, 3, 64, 64))
    sizes = [(skip.shape[1], skip.shape[-1]) for skip in skips]
    assert sizes == [(16, 64), (32, 32), (64, 16), (128, 8), (256, 4)]


@pytest.mark.parametrize("size", [48, 0, 512])
def test_an_impossible_picture_size_is_named(size):
    with pytest.raises(ValueError, match="image_size must be one of 32, 64, 128, 256"):
        NetworkSettings(image_size=size)


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
    result = gradients(actual, inputs, generator)
    wanted = gradients(expected, inputs, generator.set_state(seed))
    for index, (a, b) in enumerate(zip(result, wanted, strict=True)):
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
