"""VGG16 against its definition written out, from every container its weights come in."""

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch.nn import functional

from derender.objectives.perceptual import Vgg16Features, load_vgg16
from derender.storage.tensors import reads_safely

PICKLED = pytest.mark.skipif(not reads_safely(), reason="this PyTorch is not trusted with pickles")
CONTAINERS = [".npz", ".safetensors", pytest.param(".pth", marks=PICKLED)]

NUMBERS = (0, 2, 5, 7, 10, 12, 14)
CHANNELS = (3, 64, 64, 128, 128, 256, 256, 256)
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet, as torchvision's weights expect


@pytest.fixture(scope="module")
def weights():
    """Random weights under torchvision's names, with a later layer and a classifier that must be ignored."""
    generator = torch.Generator().manual_seed(0)
    found = {"features.17.weight": torch.zeros(2, 2), "classifier.0.weight": torch.zeros(3)}
    for number, fan_in, fan_out in zip(NUMBERS, CHANNELS[:-1], CHANNELS[1:], strict=True):
        scale = (2 / (9 * fan_in)) ** 0.5
        found[f"features.{number}.weight"] = torch.randn(fan_out, fan_in, 3, 3, generator=generator) * scale
        found[f"features.{number}.bias"] = torch.randn(fan_out, generator=generator) * 0.1
    return found


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
    found = net(images)
    assert found.shape == (2, net.channels, 16 // net.stride, 24 // net.stride)
    torch.testing.assert_close(found, relu3_3(weights, images), rtol=1e-4, atol=1e-5)


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
