"""The perceptual loss at its resolution, what every frozen extractor promises, and VGG16 by definition."""

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import nn
from torch.nn import functional

from derender.objectives.perceptual import PerceptualFeatures, Vgg16Features, load_vgg16, perceptual_loss
from derender.storage.tensors import reads_safely
from derender.training import resolve
from derender.training.derender_task import perceptual_of
from derender.training.run_folder import RunFolder


class Tiny(PerceptualFeatures):
    """Two random convolutions at half resolution."""

    stride, channels = 2, 4

    def __init__(self, generator: torch.Generator):
        layers = nn.Sequential(nn.Conv2d(3, 4, 3, padding=1), nn.ReLU(), nn.AvgPool2d(2))
        nn.init.normal_(layers[0].weight, generator=generator)
        nn.init.zeros_(layers[0].bias)
        super().__init__(layers, (0.5, 0.4, 0.3), (0.2, 0.3, 0.4))


def test_locations_of_all_images_count_by_the_share_of_their_pixels_that_the_mask_keeps():
    errors = torch.tensor([[1.0, 2.0, 5.0], [3.0, 7.0, 0.5]], dtype=torch.float64)
    target, mask = errors[:, None, None].expand(2, 2, 1, 3), torch.zeros(2, 4, 12, dtype=torch.float64)
    mask[0, :, :4] = 1  # all of the first location
    mask[0, :2, 4:8] = 1  # half of the second, none of the third
    mask[1, :, 8:] = 1  # another one of the second image
    share, prediction = torch.tensor([[1, 0.5, 0], [0, 0, 1]]), torch.zeros_like(target)
    sigma = torch.tensor([[0.5, 0.7, 9.0], [9.0, 9.0, 0.3]], dtype=torch.float64)
    scaled = errors.square() / (2 * sigma.square()) + sigma.log()
    for given, each in ((None, errors.square()), (sigma[:, None, None], scaled)):
        expected = float((share * each).sum() / 2.5)
        for kept in (mask, mask.bool()):
            result = perceptual_loss(prediction, target, kept, given).item()
            assert result == pytest.approx(expected, rel=1e-4)


def test_sigma_of_another_resolution_is_refused(generator):
    features = torch.randn(2, 2, 5, 3, 4, generator=generator)
    with pytest.raises(ValueError, match="resolution 3 x 4"):
        perceptual_loss(*features, torch.ones(2, 12, 16), torch.ones(2, 1, 6, 8))


def test_features_are_normalised_pictures_through_the_layers(generator):
    net = Tiny(generator)
    images = torch.rand(2, 3, 6, 8, generator=generator)
    channels = enumerate([(0.5, 0.2), (0.4, 0.3), (0.3, 0.4)])
    normalised = torch.stack([(images[:, c] - mean) / std for c, (mean, std) in channels], 1)
    torch.testing.assert_close(net(images), net.features(normalised))


def test_calibration_makes_the_spread_one_and_keeps_relations(generator):
    net = Tiny(generator)
    images = torch.rand(70, 3, 6, 8, generator=generator)
    before = net(images)
    net.calibrate_(images)
    after = net(images)
    spread = (after - after.mean(dim=(0, 2, 3), keepdim=True)).square().mean().sqrt()
    assert spread.item() == pytest.approx(1, rel=1e-5)
    torch.testing.assert_close(after / after.max(), before / before.max())
    again = net.scale.clone()
    assert torch.equal(net.calibrate_(images).scale, again)
    assert "scale" in net.state_dict()


def test_calibration_on_pictures_that_do_not_differ_is_refused(generator):
    net = Tiny(generator)
    net.features[0].bias.fill_(-1e3)
    with pytest.raises(ValueError, match="do not vary over 2 calibration images"):
        net.calibrate_(torch.rand(2, 3, 6, 8, generator=generator))


def test_frozen_whatever_the_model_around_does(generator):
    whole = nn.Sequential(Tiny(generator))
    whole.train()
    assert not whole[0].training and not whole[0].features.training
    assert not any(parameter.requires_grad for parameter in whole.parameters())
    images = torch.rand(1, 3, 6, 8, generator=generator, requires_grad=True)
    (gradient,) = torch.autograd.grad(whole[0](images).sum(), images)
    assert gradient.abs().sum() > 0


def test_vgg_is_calibrated_on_the_first_256_pictures_or_keeps_scale_1(monkeypatch, tmp_path):
    def weights(_: object) -> Tiny:
        return Tiny(torch.Generator().manual_seed(3))

    monkeypatch.setattr("derender.training.derender_task.load_vgg16", weights)
    images = (torch.rand(258, 3, 6, 8, generator=torch.Generator().manual_seed(0)) * 255).byte()
    expected = weights(None).calibrate_(images[:256].float() / 255).scale
    for rescaled, scale in ((True, expected), (False, torch.ones(()))):
        config = resolve("small", ["perceptual=vgg16", f"perceptual_rescaled={str(rescaled).lower()}"])
        made = perceptual_of(config, RunFolder(tmp_path), images, lambda done, total: None)
        assert torch.equal(made.scale, scale)


PICKLED = pytest.mark.skipif(not reads_safely(), reason="this PyTorch is not trusted with pickles")
CONTAINERS = [".npz", ".safetensors", pytest.param(".pth", marks=PICKLED)]

NUMBERS = (0, 2, 5, 7, 10, 12, 14)
CHANNELS = (3, 64, 64, 128, 128, 256, 256, 256)
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet, as torchvision's weights expect


@pytest.fixture(scope="module")
def weights():
    """Random weights under torchvision's names, with a later layer and a classifier that must be ignored."""
    generator = torch.Generator().manual_seed(0)
    result = {"features.17.weight": torch.zeros(2, 2), "classifier.0.weight": torch.zeros(3)}
    for number, fan_in, fan_out in zip(NUMBERS, CHANNELS[:-1], CHANNELS[1:], strict=True):
        scale = (2 / (9 * fan_in)) ** 0.5
        result[f"features.{number}.weight"] = torch.randn(fan_out, fan_in, 3, 3, generator=generator) * scale
        result[f"features.{number}.bias"] = torch.randn(fan_out, generator=generator) * 0.1
    return result


def relu3_3(weights, images):
    """Configuration D of Simonyan & Zisserman written out, up to the third convolution of block three."""
    x = (images - torch.tensor(MEAN).view(3, 1, 1)) / torch.tensor(STD).view(3, 1, 1)
    for block in ((0, 2), (5, 7), (10, 12, 14)):
        if block[0] > 0:
            x = functional.max_pool2d(x, 2)
        for number in block:
            kernel, bias = (weights[f"features.{number}.{part}"] for part in ("weight", "bias"))
            x = functional.relu(functional.conv2d(x, kernel, bias, padding=1))
    return x


def write(weights, path):
    if path.suffix == ".npz":
        np.savez(path, **{name: value.numpy() for name, value in weights.items()})
    elif path.suffix == ".safetensors":
        save_file(weights, path)
    else:
        torch.save(weights, path)
    return path


@pytest.mark.parametrize("suffix", CONTAINERS)
def test_every_container_gives_the_features_by_definition(weights, tmp_path, generator, suffix):
    net = load_vgg16(write(weights, tmp_path / f"vgg{suffix}"))
    images = torch.rand(2, 3, 16, 24, generator=generator)
    result = net(images)
    assert result.shape == (2, net.channels, 16 // net.stride, 24 // net.stride)
    torch.testing.assert_close(result, relu3_3(weights, images), rtol=1e-4, atol=1e-5)


@PICKLED
def test_torch_hubs_cache_is_found_and_never_filled(weights, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", lambda *a, **k: pytest.fail("downloads"))
    (tmp_path / "checkpoints").mkdir()
    write({"features.0.weight": torch.zeros(1)}, tmp_path / "checkpoints" / "vgg16_bn-6c64b313.pth")
    with pytest.raises(ValueError, match=r"no vgg16-\*\.pth in torch hub's cache .*vgg16-397923af\.pth"):
        load_vgg16()
    write(weights, tmp_path / "checkpoints" / "vgg16-397923af.pth")
    torch.testing.assert_close(load_vgg16().features[0].weight, weights["features.0.weight"])


def test_only_seven_convolutions_remain():
    net = Vgg16Features()
    assert sum(parameter.numel() for parameter in net.parameters()) == 1_735_488
    assert [i for i, layer in enumerate(net.features) if isinstance(layer, torch.nn.Conv2d)] == list(NUMBERS)


def test_weights_that_do_not_fit_are_named(weights, tmp_path):
    missing = {name: value for name, value in weights.items() if name != "features.7.bias"}
    with pytest.raises(ValueError, match=r"not torchvision's VGG16 \(it has no 'features\.7\.bias'"):
        load_vgg16(write(missing, tmp_path / "missing.safetensors"))
    wrong = {**weights, "features.0.weight": torch.zeros(64, 1, 3, 3)}
    with pytest.raises(ValueError, match=r"'features\.0\.weight' has shape \(64, 1, 3, 3\)"):
        load_vgg16(write(wrong, tmp_path / "wrong.npz"))


@PICKLED
def test_pickles_of_something_else_are_refused(tmp_path):
    torch.save(torch.zeros(3), tmp_path / "tensor.pth")
    with pytest.raises(ValueError, match="holds no named weights"):
        load_vgg16(tmp_path / "tensor.pth")


@pytest.mark.parametrize("suffix", [*CONTAINERS, ".onnx"])
def test_damaged_and_other_files_are_refused_in_one_sentence(tmp_path, suffix):
    path = tmp_path / f"damaged{suffix}"
    with pytest.raises(ValueError, match=r"no VGG16 weights at .*damaged"):
        load_vgg16(path)
    path.write_bytes(b"this is not a weight file")
    with pytest.raises(ValueError, match=r"VGG16 weights in .*damaged.*(cannot be read|expected a \.npz)"):
        load_vgg16(path)
