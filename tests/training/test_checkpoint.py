"""Checkpoints whose checksums are right and whose content is not: a stranger's."""

import json

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import nn

from derender.storage.atomic import CHECKSUMS, seal
from derender.training.checkpoint import TrainState, fit_weights, load_checkpoint, save_checkpoint


def fresh(width=5):
    torch.manual_seed(0)
    net = torch.nn.Linear(width, 3)
    return net, torch.optim.Adam(net.parameters(), lr=0.01, fused=True)


def step(net, optimiser):
    optimiser.zero_grad()
    net(torch.ones(1, 5)).sum().backward()
    optimiser.step()


@pytest.fixture
def changed(tmp_path):
    """Writes a checkpoint with changed moments or notes, and its checksums."""

    def write(moments=lambda name, value: value, **notes):
        net, optimiser = fresh()
        step(net, optimiser)
        folder = tmp_path / "last"
        save_checkpoint(folder, net, optimiser, TrainState(images=8))
        kept = load_file(folder / "optimiser.safetensors")
        moved = {name: moments(name, value) for name, value in kept.items()}
        moved = {name: value for name, value in moved.items() if value is not None}
        save_file(moved, folder / "optimiser.safetensors")
        described = json.loads((folder / "state.json").read_text())
        described["state"] |= notes.pop("state", {})
        described["groups"][0] |= notes
        (folder / "state.json").write_text(json.dumps(described))
        (folder / CHECKSUMS).unlink()
        seal(folder)
        return folder

    return write


@pytest.mark.parametrize(
    ("moments", "message"),
    [
        (lambda name, value: value[:1].clone() if value.ndim else value, r"0.exp_avg has shape \(1, 5\)"),
        (lambda name, value: value if value.ndim else torch.zeros(2), r"0.step has shape \(2,\)"),
        (lambda name, value: None if "exp_avg_sq" in name else value, r"state 0 holds exp_avg, step"),
    ],
)
def test_moments_that_are_not_of_the_parameters_are_refused(changed, moments, message):
    """A fused step took them by the size of the parameters, beyond their end."""
    with pytest.raises(ValueError, match=message):
        load_checkpoint(changed(moments), *fresh())


@pytest.mark.parametrize("wrong", [{"maximize": True}, {"amsgrad": True}, {"eps": "x"}, {"lr": None}])
def test_how_a_step_is_computed_does_not_come_from_the_file(changed, wrong):
    resumed = fresh()
    load_checkpoint(changed(**wrong), *resumed)
    expected = fresh()
    for net, optimiser in (expected, expected, resumed):
        step(net, optimiser)
    assert torch.equal(resumed[0].weight, expected[0].weight)


@pytest.mark.parametrize(
    "wrong",
    [
        *({"images": value} for value in ("8", -8, 8.5, None, True, 1 << 70)),
        *({"seconds": value} for value in ("8", None, float("nan"))),
        *({"best_loss": value} for value in ("8", float("inf"))),
        {"validations_since_best": -1},
        {"watcher": []},
    ],
)
def test_counters_that_no_run_notes_are_refused(changed, wrong):
    with pytest.raises(ValueError, match=rf"of another model \({next(iter(wrong))}"):
        load_checkpoint(changed(state=wrong), *fresh())


def normalised(width: int = 3) -> nn.Module:
    return nn.Sequential(nn.Linear(2, width), nn.BatchNorm1d(width), nn.Linear(width, 1))


def test_the_first_weight_that_does_not_fit_is_named_and_nothing_is_changed():
    target = normalised()
    before = {name: value.clone() for name, value in target.state_dict().items()}
    given = normalised().state_dict()
    few = {name: value for name, value in given.items() if name not in ("1.running_var", "2.bias")}
    shape = r"'0\.weight' has shape \(4, 2\) there and \(3, 2\) in this architecture"
    for weights, message in [
        (normalised(4).state_dict(), shape),
        ({**given, "stranger": torch.zeros(1)}, "it has 'stranger', which this architecture lacks"),
        (few, r"it has no '1\.running_var', which this architecture needs"),
    ]:
        with pytest.raises(ValueError, match=message):
            fit_weights(target, weights)
    assert all(torch.equal(value, target.state_dict()[name]) for name, value in before.items())
