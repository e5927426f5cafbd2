"""Checkpoints of unsup3d: a synthetic one in the published layout comes through, others are named.

No published file was at hand. What is written here follows the paper's appendix: the order and the shapes of
the layers, one convolution of 1x1 at the end of light and view, GroupNorm as weight and bias.
"""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from tests.trust.test_no_code import Bomb
from torch import Tensor, nn

from derender.cli import main
from derender.model import Derenderer, load
from derender.networks.unsup3d import read_checkpoint
from derender.storage.tensors import reads_safely

pytestmark = pytest.mark.skipif(not reads_safely(), reason="this PyTorch is not trusted with pickles")

WIDTH, LIGHT, CODE, CONFIDENCE = 8, 4, 32, 16


def conv(channels_in: int, channels_out: int, kernel: int) -> nn.Module:
    return nn.Conv2d(channels_in, channels_out, kernel, bias=False)


def deconv(channels_in: int, channels_out: int) -> nn.Module:
    return nn.ConvTranspose2d(channels_in, channels_out, 4, bias=False)


def norm(channels: int) -> nn.Module:
    return nn.GroupNorm(channels // 4, channels)


def encoder(width: int, code: int) -> list[nn.Module]:
    layers: list[nn.Module] = [conv(3, width, 4), norm(width), nn.LeakyReLU(0.2)]
    layers += [conv(width, 2 * width, 4), norm(2 * width), nn.LeakyReLU(0.2)]
    layers += [conv(2 * width, 4 * width, 4), norm(4 * width), nn.LeakyReLU(0.2)]
    return [*layers, conv(4 * width, 8 * width, 4), nn.LeakyReLU(0.2), conv(8 * width, code, 4), nn.ReLU()]


def map_net(channels: int) -> nn.Sequential:
    layers = encoder(WIDTH, CODE)
    layers += [deconv(CODE, 8 * WIDTH), nn.ReLU(), conv(8 * WIDTH, 8 * WIDTH, 3), nn.ReLU()]
    for wide in (8 * WIDTH, 4 * WIDTH, 2 * WIDTH):
        half = wide // 2
        layers += [deconv(wide, half), norm(half), nn.ReLU(), conv(half, half, 3), norm(half), nn.ReLU()]
    layers += [nn.Upsample(scale_factor=2), conv(WIDTH, WIDTH, 3), norm(WIDTH), nn.ReLU()]
    return nn.Sequential(*layers, conv(WIDTH, WIDTH, 5), norm(WIDTH), nn.ReLU(), conv(WIDTH, channels, 5))


def vector_net(numbers: int) -> nn.Sequential:
    widths = [3, LIGHT, 2 * LIGHT, 4 * LIGHT, 8 * LIGHT]
    layers: list[nn.Module] = []
    for before, after in pairwise(widths):
        layers += [conv(before, after, 4), nn.ReLU()]
    return nn.Sequential(*layers, conv(widths[-1], CODE, 4), nn.ReLU(), conv(CODE, numbers, 1), nn.Tanh())


def confidence_net() -> dict[str, Tensor]:
    trunk = [*encoder(WIDTH, CONFIDENCE), deconv(CONFIDENCE, 8 * WIDTH), nn.ReLU()]
    for before, after in ((8 * WIDTH, 4 * WIDTH), (4 * WIDTH, 2 * WIDTH)):
        trunk += [deconv(before, after), norm(after), nn.ReLU()]
    first: list[nn.Module] = []
    for before, after in ((2 * WIDTH, WIDTH), (WIDTH, WIDTH)):
        first += [deconv(before, after), norm(after), nn.ReLU()]
    heads = {"head1": [*first, conv(WIDTH, 2, 5)], "head2": [conv(2 * WIDTH, 2, 3)]}
    parts = {name: nn.Sequential(*layers) for name, layers in {"network": trunk, **heads}.items()}
    return nn.ModuleDict(parts).state_dict()


@pytest.fixture(scope="module")
def checkpoint() -> dict:
    """Nets as state dictionaries, beside them what a training leaves there."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        nets = {"netD": map_net(1), "netA": map_net(3), "netL": vector_net(4), "netV": vector_net(6)}
        states = {name: nn.ModuleDict({"network": net}).state_dict() for name, net in nets.items()}
        states["netC"] = confidence_net()
    adams = {name: torch.optim.Adam(net.parameters()) for name, net in nets.items()}
    optimisers = {f"optimizer{name[-1]}": adam.state_dict() for name, adam in adams.items()}
    return {**states, **optimisers, "epoch": 30}


@pytest.fixture
def file(checkpoint, tmp_path) -> Path:
    torch.save(checkpoint, tmp_path / "checkpoint030.pth")
    return tmp_path / "checkpoint030.pth"


def test_sizes_are_read_off_and_every_tensor_finds_its_place(checkpoint, file):
    settings, weights = read_checkpoint(file)
    assert (settings.image_size, settings.width, settings.light_width) == (64, WIDTH, LIGHT)
    assert (settings.code_size, settings.confidence_code_size) == (CODE, CONFIDENCE)
    model = Derenderer.from_unsup3d(file)
    assert weights.keys() == model.state_dict().keys()
    first = model.nets["geometry"].encoder.convolutions[0].weight
    assert torch.equal(first, checkpoint["netD"]["network.0.weight"])
    assert torch.equal(model.nets["albedo"].decoder.last.weight, list(checkpoint["netA"].values())[-1])


def test_the_networks_compute_what_the_layers_of_the_paper_compute(checkpoint, file):
    """Camera and light, by torch's own layers with the paper's strides and paddings.

    Light has x, then y in the file; pitch (y), then yaw (x) here.
    """
    model = Derenderer.from_unsup3d(file)
    images = torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(1))
    for net, name in (("netV", "camera"), ("netL", "light")):
        values, tensors = images * 2 - 1, list(checkpoint[net].values())
        for weight in tensors[:4]:
            values = torch.conv2d(values, weight, stride=2, padding=1).relu()
        values = torch.conv2d(torch.conv2d(values, tensors[4]).relu(), tensors[5]).tanh().flatten(1)
        expected = values[:, [0, 1, 3, 2]] if name == "light" else values
        torch.testing.assert_close(model.nets[name](images), expected, rtol=1e-4, atol=1e-5)


def saved(content: object, folder: Path, **options) -> Path:
    torch.save(content, folder / "other.pth", **options)
    return folder / "other.pth"


def test_files_of_old_torch_and_flat_names_are_read_too(checkpoint, file, tmp_path):
    _, expected = read_checkpoint(file)
    nets = ("netD", "netA", "netL", "netV")
    flat = {f"{net}.{name}": value for net in nets for name, value in checkpoint[net].items()}
    _, result = read_checkpoint(saved(flat, tmp_path, _use_new_zipfile_serialization=False))
    assert result and all(torch.equal(result[name], expected[name]) for name in result)
    assert not any(name.startswith("nets.confidence") for name in result)


class Meter:
    """What a training loop keeps of its losses."""

    def __init__(self):
        self.values = [1.0, 2.0]


@pytest.mark.parametrize("zipped", [True, False])
def test_objects_beside_the_weights_are_neither_run_nor_in_the_way(checkpoint, file, tmp_path, zipped):
    with_more = {**checkpoint, "metrics": Meter(), "loss": np.float64(1.0)}
    _, weights = read_checkpoint(saved(with_more, tmp_path, _use_new_zipfile_serialization=zipped))
    _, expected = read_checkpoint(file)
    assert all(torch.equal(weights[name], value) for name, value in expected.items())
    with pytest.raises(ValueError, match="wants to run code when read: not opened"):
        read_checkpoint(saved({**checkpoint, "trap": Bomb(tmp_path / "executed")}, tmp_path))
    assert not (tmp_path / "executed").exists()


def test_another_architecture_is_named_by_its_first_tensor(checkpoint, tmp_path):
    changed = dict(checkpoint["netA"])
    changed["network.3.weight"] = torch.zeros(5, 5)
    with pytest.raises(ValueError, match=r"netA has network.3.weight of shape \(5, 5\) where \(16, 8, 4, "):
        read_checkpoint(saved({**checkpoint, "netA": changed}, tmp_path))
    shorter = dict(list(checkpoint["netV"].items())[:-1])
    with pytest.raises(ValueError, match="netV has 5 tensors, expected 6"):
        read_checkpoint(saved({**checkpoint, "netV": shorter}, tmp_path))
    broken = {**checkpoint["netD"], "network.0.weight": checkpoint["netD"]["network.0.weight"] * torch.nan}
    with pytest.raises(ValueError, match=r"netD has network.0.weight with NaN or infinite values"):
        read_checkpoint(saved({**checkpoint, "netD": broken}, tmp_path))


def test_files_that_are_no_checkpoint_say_what_they_are(checkpoint, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"give the \.pth file that unsup3d wrote"):
        read_checkpoint(tmp_path / "none.pth")
    with pytest.raises(ValueError, match=r"it has no netD \(it holds state_dict\)"):
        read_checkpoint(saved({"state_dict": {}}, tmp_path))
    with pytest.raises(ValueError, match="holds list, no checkpoint"):
        read_checkpoint(saved([1], tmp_path))
    (tmp_path / "text.pth").write_text("not found")
    with pytest.raises(ValueError, match="damaged"):
        read_checkpoint(tmp_path / "text.pth")
    whole = saved(checkpoint, tmp_path).read_bytes()
    (tmp_path / "cut.pth").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="damaged"):
        read_checkpoint(tmp_path / "cut.pth")


def test_the_command_writes_a_model_that_loads(file, tmp_path, capsys):
    out = tmp_path / "imported"
    words = ["import", str(file), "--out", str(out)]
    assert main([*words, "--preset", "cars", "--set", "translation_z=0.1"]) == 0
    ranges = load(out).settings.ranges
    assert (ranges.border_depth, ranges.diffuse, ranges.translation_z) == (1.08, (0.5, 1.0), 0.1)
    assert "a checkpoint of unsup3d" in (out / "README.md").read_text()
    assert main(words) == 2
    assert "add --force" in capsys.readouterr().err
    assert main(["import", str(file), "--preset", "dogs", "--out", str(tmp_path / "no")]) == 2
    assert not (tmp_path / "no").exists()
