"""Pickles of others are not opened by a PyTorch that a crafted one could make run code."""

import pytest
import torch
from torch.torch_version import TorchVersion

from derender.baselines.published import read_weights
from derender.networks.unsup3d import read_checkpoint
from derender.objectives.perceptual_features import load_vgg16
from derender.storage.tensors import reads_safely


@pytest.mark.parametrize(
    "version, safe", [("2.6.0+cpu", False), ("2.9.1", False), ("2.10.0", True), ("2.13.0+cpu", True)]
)
def test_torch_is_trusted_from_2_10_on(version, safe, monkeypatch):
    monkeypatch.setattr(torch, "__version__", TorchVersion(version))
    assert reads_safely() is safe


@pytest.mark.parametrize(
    "read", [load_vgg16, read_checkpoint, lambda file: read_weights(file, "the published file")]
)
def test_an_older_one_is_not_asked(read, tmp_path, monkeypatch):
    file = tmp_path / "weights.pth"
    torch.save({"weight": torch.zeros(1)}, file)
    monkeypatch.setattr(torch, "__version__", TorchVersion("2.9.1+cu128"))
    monkeypatch.setattr(torch, "load", lambda *_, **__: pytest.fail("the file was opened"))
    with pytest.raises(ValueError, match=r"PyTorch 2\.9\.1\+cu128 can be made to run code.*PyTorch 2\.10\.0"):
        read(file)
