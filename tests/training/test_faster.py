"""Steps made faster: networks compiled where that was faster and the loss the same, else left as they were.

On a GPU replayed steps give the bits of ordinary ones, and runs resume exactly in either way.
"""

import json

import numpy as np
import pytest
import torch
from tests.training.conftest import noise_set
from torch import nn

from derender.model import load
from derender.training import faster, loop, train
from derender.training.config import resolve

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit:DeprecationWarning")  # as torch's compiler imports


def model() -> nn.ModuleDict:
    return nn.ModuleDict({"shape": nn.ModuleDict({"encoder": nn.Linear(2, 2)}), "light": nn.Linear(2, 1)})


def are_compiled(nets: nn.Module) -> list[bool]:
    return [network._compiled_call_impl is not None for network in faster.networks_of(nets)]


@pytest.fixture
def clock(monkeypatch):
    """Results of timing, in turn; an exception is raised. Compiling itself is left to torch's own tests."""
    results: list = []

    def timed(step):
        result = results.pop(0)
        if isinstance(result, Exception):
            raise result
        return result

    monkeypatch.setattr(faster, "_timed", timed)
    return results


@pytest.mark.parametrize(
    ("times", "kept", "told"),
    [
        ([(1.0, 2.0), (0.5, 2.0)], True, "networks are compiled: steps are 2.00 times as fast"),
        ([(1.0, 2.0), (2.0, 2.0)], False, "slower compiled (0.50 times"),
        ([(1.0, 2.0), (0.5, 3.0)], False, "another loss compiled (3 for 2)"),
        ([(1.0, 2.0), (0.5, float("nan"))], False, "another loss"),
        ([(1.0, 2.0), RuntimeError("no C++ compiler\nmore")], False, "cannot be compiled (no C++ compiler)"),
    ],
)
def test_networks_are_compiled_where_that_is_faster(clock, times, kept, told):
    nets, notes = model(), []
    clock += times
    assert faster.compile_networks(nets, lambda: 0.0, notes.append) is kept
    assert are_compiled(nets) == [kept, kept] and len(notes) == 1 and told in notes[0]


def test_a_choice_that_was_made_is_kept_without_timing(clock):
    nets = model()
    assert not faster.compile_networks(nets, lambda: 0.0, pytest.fail, wanted=False)
    assert are_compiled(nets) == [False, False]
    clock.append((9.0, 2.0))
    assert faster.compile_networks(nets, lambda: 0.0, pytest.fail, wanted=True)
    assert are_compiled(nets) == [True, True]
    clock.append(RuntimeError("no C++ compiler"))
    with pytest.raises(ValueError, match=r"cannot be compiled .* resume it with compile=off"):
        faster.compile_networks(nets, lambda: 0.0, pytest.fail, wanted=True)


def test_a_run_asks_once_and_resumes_as_it_began(tmp_path, monkeypatch):
    asked = []

    def choose(nets, step, report, wanted):
        before = [value.clone() for value in nets.parameters()]
        assert step() == step() and np.isfinite(step())
        assert all(torch.equal(one, other) for one, other in zip(before, nets.parameters(), strict=True))
        asked.append(wanted)
        return True

    monkeypatch.setattr(loop, "compile_networks", choose)
    small = ("image_size=32", "batch_size=4", "self_features_steps=2", "pictures=0")

    def trained(*changes, **how):
        train(resolve("small", (*small, *changes)), noise_set(20), tmp_path / "run", **how)
        state = json.loads((tmp_path / "run" / "checkpoints" / "last" / "state.json").read_text())
        return state["state"]["compiled"]

    assert trained("images=8", "compile=auto") is True and asked == [None]
    assert trained("images=16", "compile=auto", resume=True) is True and asked == [None, True]
    assert trained("images=24", "compile=off", resume=True) is True and asked == [None, True]


on_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")

SMALL = (
    *("image_size=32", "batch_size=8", "images=800", "validate_every=400", "checkpoint_every=400"),
    *("self_features_steps=20", "pictures=0", "deterministic=true", "loocc=all", "cycle_weight=0.1"),
)


def trained(folder, *overrides, **how):
    train(resolve("small", (*SMALL, *overrides)), noise_set(80), folder, **how)
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    notes = [line["text"] for line in lines if line["kind"] == "note"]
    return load(folder / "model").state_dict(), notes


def same(one, other) -> bool:
    return all(torch.equal(value, other[name]) for name, value in one.items())


@on_gpu
def test_replayed_steps_are_ordinary_steps(tmp_path):
    replayed, notes = trained(tmp_path / "replayed")
    ordinary, silent = trained(tmp_path / "ordinary", "cuda_graph=off")
    assert len(notes) == 1 and "CUDA graph" in notes[0] and not silent
    assert same(replayed, ordinary)


@on_gpu
def test_a_template_start_is_recorded_anew_for_each_of_its_phases(tmp_path):
    shares = ("template_share=0.6", "release_share=0.1")
    replayed, notes = trained(tmp_path / "replayed", *shares)
    ordinary, _ = trained(tmp_path / "ordinary", *shares, "cuda_graph=off")
    assert len(notes) == 1 and same(replayed, ordinary)


@on_gpu
def test_a_run_resumes_to_the_same_weights_in_either_way(tmp_path):
    whole, _ = trained(tmp_path / "whole")
    trained(tmp_path / "parts", "images=400")
    resumed, _ = trained(tmp_path / "parts", "cuda_graph=off", resume=True)
    assert same(whole, resumed)
