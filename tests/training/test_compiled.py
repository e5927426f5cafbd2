"""Networks are compiled where that was faster and the loss the same, and else left as they were."""

import json

import numpy as np
import pytest
import torch
from torch import nn

from derender.data import ImageSet
from derender.training import compiled, loop, train
from derender.training.config import resolve

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit:DeprecationWarning")  # as torch's compiler imports


def model() -> nn.ModuleDict:
    return nn.ModuleDict({"shape": nn.ModuleDict({"encoder": nn.Linear(2, 2)}), "light": nn.Linear(2, 1)})


def are_compiled(nets: nn.Module) -> list[bool]:
    return [network._compiled_call_impl is not None for network in compiled.networks_of(nets)]


@pytest.fixture
def clock(monkeypatch):
    """Results of timing, in turn; an exception is raised. Compiling itself is left to torch's own tests."""
    results: list = []

    def timed(step):
        result = results.pop(0)
        if isinstance(result, Exception):
            raise result
        return result

    monkeypatch.setattr(compiled, "_timed", timed)
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
    assert compiled.compile_networks(nets, lambda: 0.0, notes.append) is kept
    assert are_compiled(nets) == [kept, kept] and len(notes) == 1 and told in notes[0]


def test_a_choice_that_was_made_is_kept_without_timing(clock):
    nets = model()
    assert not compiled.compile_networks(nets, lambda: 0.0, pytest.fail, wanted=False)
    assert are_compiled(nets) == [False, False]
    clock.append((9.0, 2.0))
    assert compiled.compile_networks(nets, lambda: 0.0, pytest.fail, wanted=True)
    assert are_compiled(nets) == [True, True]
    clock.append(RuntimeError("no C++ compiler"))
    with pytest.raises(ValueError, match=r"cannot be compiled .* resume it with compile=off"):
        compiled.compile_networks(nets, lambda: 0.0, pytest.fail, wanted=True)


def test_a_run_asks_once_and_resumes_as_it_began(tmp_path, monkeypatch):
    asked = []

    def choose(nets, step, report, wanted):
        before = [value.clone() for value in nets.parameters()]
        assert step() == step() and np.isfinite(step())
        assert all(torch.equal(one, other) for one, other in zip(before, nets.parameters(), strict=True))
        asked.append(wanted)
        return True

    monkeypatch.setattr(loop, "compile_networks", choose)
    pixels = np.random.default_rng(0).integers(0, 256, (20, 3, 32, 32), dtype=np.uint8)
    images = ImageSet(
        images=pixels, files=tuple(f"{i:02d}.png" for i in range(20)), source="made by the test"
    )
    small = ("image_size=32", "batch_size=4", "self_features_steps=2", "pictures=0")

    def trained(*changes, **how):
        train(resolve("small", (*small, *changes)), images, tmp_path / "run", **how)
        state = json.loads((tmp_path / "run" / "checkpoints" / "last" / "state.json").read_text())
        return state["state"]["compiled"]

    assert trained("images=8", "compile=auto") is True and asked == [None]
    assert trained("images=16", "compile=auto", resume=True) is True and asked == [None, True]
    assert trained("images=24", "compile=off", resume=True) is True and asked == [None, True]
