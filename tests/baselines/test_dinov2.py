"""DINOv2 is read from a folder or the cache, as safetensors only, and describes as transformers does."""

import json
import pickle

import pytest
import torch
from torch.nn.functional import interpolate
from transformers import Dinov2Config, Dinov2Model, ViTConfig, ViTModel

from derender.baselines.dinov2 import IMAGENET_MEAN, IMAGENET_STD, load_dinov2

TINY = {
    "hidden_size": 8,
    "num_hidden_layers": 2,
    "num_attention_heads": 2,
    "image_size": 28,
    "patch_size": 14,
}


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A tiny DINOv2 with random weights in a folder, and the network itself."""
    folder = tmp_path_factory.mktemp("dinov2")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        net = Dinov2Model(Dinov2Config(**TINY)).eval()
    net.save_pretrained(folder)
    return folder, net


def test_features_are_the_class_token_and_the_mean_patch(saved):
    folder, net = saved
    model = load_dinov2(str(folder), image_size=32, enlarged=28)
    model.choose(("class", "patches"))
    images = torch.rand(3, 3, 32, 32)
    features = model.embed(images)
    large = interpolate(images, (28, 28), mode="bicubic", antialias=True).clamp(0, 1)
    mean, std = (torch.tensor(values).view(3, 1, 1) for values in (IMAGENET_MEAN, IMAGENET_STD))
    with torch.no_grad():
        tokens = net(pixel_values=(large - mean) / std).last_hidden_state
    torch.testing.assert_close(features["class"], tokens[:, 0])
    torch.testing.assert_close(features["patches"], tokens[:, 1:].mean(dim=1))
    assert not model.training and not any(value.requires_grad for value in model.parameters())


def test_weights_that_are_not_here_are_named_with_how_to_get_them():
    with pytest.raises(
        ValueError, match=r"weights someone/no-such-weights are not in the Hugging Face cache"
    ):
        load_dinov2("someone/no-such-weights")
    with pytest.raises(ValueError, match="run 'hf download someone/no-such-weights' once"):
        load_dinov2("someone/no-such-weights")


def test_pickles_other_networks_and_other_architectures_are_refused(saved, tmp_path):
    _, net = saved

    class Trap:
        def __reduce__(self):
            return (open, (str(tmp_path / "sprung"), "w"))

    with pytest.raises(ValueError, match=r"x\.pth is a pickle, which can run code"):
        load_dinov2(str(tmp_path / "x.pth"))
    pickled = tmp_path / "pickled"
    net.config.save_pretrained(pickled)
    (pickled / "pytorch_model.bin").write_bytes(pickle.dumps(Trap()))
    with pytest.raises(ValueError, match="pickles are not opened"):
        load_dinov2(str(pickled))
    assert not (tmp_path / "sprung").exists()
    other = tmp_path / "other"
    ViTModel(ViTConfig(**TINY, intermediate_size=8)).save_pretrained(other)
    with pytest.raises(ValueError, match="is a vit, expected a dinov2"):
        load_dinov2(str(other))
    deeper = tmp_path / "deeper"
    net.save_pretrained(deeper)
    Dinov2Config(**{**TINY, "num_hidden_layers": 3}).save_pretrained(deeper)
    with pytest.raises(ValueError, match=r"of another architecture: it has no 'encoder\.layer\.2"):
        load_dinov2(str(deeper))


def test_weights_in_parts_cannot_name_files_outside_their_folder(saved, tmp_path):
    _, net = saved
    folder, outside = tmp_path / "parts", tmp_path / "outside"
    net.save_pretrained(outside)
    net.config.save_pretrained(folder)
    names = dict.fromkeys(net.state_dict(), "../outside/model.safetensors")
    (folder / "model.safetensors.index.json").write_text(json.dumps({"metadata": {}, "weight_map": names}))
    with pytest.raises(ValueError, match=r"parts has no model\.safetensors: .*weights in several parts"):
        load_dinov2(str(folder))
