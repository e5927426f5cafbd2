"""DINOv2: the numbers that come back, and weights that are refused."""

import json
import pickle

import pytest
import torch
import transformers
from tests.trust.test_no_code import Bomb
from torch.nn.functional import interpolate

from derender.baselines.dinov2 import IMAGENET_MEAN, IMAGENET_STD, Dinov2

TINY = {"hidden_size": 8, "num_hidden_layers": 2, "num_attention_heads": 2}
TINY |= {"image_size": 28, "patch_size": 14}


@pytest.fixture(scope="module")
def dinov2(tmp_path_factory, seeded):
    """A tiny DINOv2 with random weights in a folder, and the network itself."""
    folder = tmp_path_factory.mktemp("dinov2")
    net = seeded(transformers.Dinov2Model, transformers.Dinov2Config(**TINY)).eval()
    net.save_pretrained(folder)
    return folder, net


def test_features_of_dinov2_are_the_class_token_and_the_mean_patch(dinov2):
    folder, net = dinov2
    model = Dinov2.open(str(folder), image_size=32)
    model.choose(("class", "patches"))
    images = torch.rand(3, 3, 32, 32)
    features = model.embed(images)
    large = interpolate(images, (224, 224), mode="bicubic", antialias=True).clamp(0, 1)
    mean, std = (torch.tensor(values).view(3, 1, 1) for values in (IMAGENET_MEAN, IMAGENET_STD))
    with torch.no_grad():
        tokens = net(pixel_values=(large - mean) / std).last_hidden_state
    torch.testing.assert_close(features["class"], tokens[:, 0])
    torch.testing.assert_close(features["patches"], tokens[:, 1:].mean(dim=1))
    assert not model.training and not any(value.requires_grad for value in model.parameters())


def test_other_weights_than_a_dinov2_in_one_safetensors_file_are_refused(dinov2, tmp_path):
    _, net = dinov2
    pickled, other, deeper, parts = (tmp_path / name for name in ("pickled", "other", "deeper", "parts"))
    net.config.save_pretrained(pickled)
    (pickled / "pytorch_model.bin").write_bytes(pickle.dumps(Bomb(tmp_path / "it-ran")))
    transformers.ViTModel(transformers.ViTConfig(**TINY, intermediate_size=8)).save_pretrained(other)
    net.save_pretrained(deeper)
    transformers.Dinov2Config(**{**TINY, "num_hidden_layers": 3}).save_pretrained(deeper)
    net.config.save_pretrained(parts)  # an index of shards, which could name files outside the folder
    names = dict.fromkeys(net.state_dict(), "../deeper/model.safetensors")
    (parts / "model.safetensors.index.json").write_text(json.dumps({"metadata": {}, "weight_map": names}))
    for source, told in (
        (tmp_path / "x.pth", r"x\.pth has no model\.safetensors: .*pickles, which can run code"),
        (pickled, "pickles, which can run code, are not opened"),
        (other, "is a vit, expected a dinov2"),
        (deeper, r"of another architecture: it has no 'encoder\.layer\.2"),
        (parts, r"parts has no model\.safetensors: .*Weights in parts"),
        ("someone/none", "weights someone/none are not in the Hugging Face cache.*'hf download someone/none"),
    ):
        with pytest.raises(ValueError, match=told):
            Dinov2.open(str(source))
    assert not (tmp_path / "it-ran").exists()
