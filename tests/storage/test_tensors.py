"""Tensors on disk: bytes with a unit come back as numbers, or are refused; pickles need a new PyTorch."""

import pytest
import torch
from torch.torch_version import TorchVersion

from derender.networks.unsup3d import read_checkpoint
from derender.objectives.perceptual import load_vgg16
from derender.storage.tensors import UNIT, packed, read_tensors, reads_safely, write_tensors


@pytest.mark.parametrize("along", [0, 1])
def test_packed_numbers_are_off_by_half_a_unit_of_their_slice_at_most(tmp_path, along):
    value = torch.randn(40, 30, generator=torch.Generator().manual_seed(0))
    value *= torch.logspace(-6, 3, value.shape[along]).unsqueeze(1 - along)
    bytes_, unit = packed(value, along)
    write_tensors({"map": bytes_, f"map{UNIT}": unit, "mean": value[0]}, tmp_path / "t.safetensors")
    result = read_tensors(tmp_path / "t.safetensors")
    assert set(result) == {"map", "mean"} and result["map"].dtype == torch.float32
    assert bool(((result["map"] - value).abs() <= 0.501 * unit).all())
    assert torch.equal(result["mean"], value[0])


@pytest.mark.parametrize(
    ("tensors", "message"),
    [
        ({"a.unit": torch.ones(1, 1)}, "the unit of no tensor"),
        ({"a": torch.ones(2, 2), "a.unit": torch.ones(1, 2)}, "the unit of no tensor"),
        ({"a": torch.ones(2, 2, dtype=torch.int8), "a.unit": torch.ones(2)}, "the unit of no tensor"),
        ({"a": torch.ones(2, 2, dtype=torch.int8), "a.unit": torch.ones(1, 3)}, "does not fit"),
    ],
)
def test_units_that_do_not_fit_are_refused(tmp_path, tensors, message):
    write_tensors(tensors, tmp_path / "t.safetensors")
    with pytest.raises(ValueError, match=message):
        read_tensors(tmp_path / "t.safetensors")


@pytest.mark.parametrize(
    "version, safe", [("2.6.0+cpu", False), ("2.9.1", False), ("2.10.0", True), ("2.13.0+cpu", True)]
)
def test_torch_is_trusted_from_2_10_on(version, safe, monkeypatch):
    monkeypatch.setattr(torch, "__version__", TorchVersion(version))
    assert reads_safely() is safe


@pytest.mark.parametrize("read", [load_vgg16, read_checkpoint])
def test_an_older_one_is_not_asked(read, tmp_path, monkeypatch):
    file = tmp_path / "weights.pth"
    torch.save({"weight": torch.zeros(1)}, file)
    monkeypatch.setattr(torch, "__version__", TorchVersion("2.9.1+cu128"))
    monkeypatch.setattr(torch, "load", lambda *_, **__: pytest.fail("the file was opened"))
    with pytest.raises(ValueError, match=r"PyTorch 2\.9\.1\+cu128 can be made to run code.*PyTorch 2\.10\.0"):
        read(file)
