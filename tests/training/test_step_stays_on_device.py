"""A training step asks the host for nothing: no number is read back and none is brought anew.

Either would stop the device in every step, and neither can be part of a CUDA graph. Seen on the CPU, where
the same calls are made.
"""

import pytest
import torch
from tests.training.conftest import noise_set
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from derender.model import Derenderer
from derender.objectives.perceptual import Vgg16Features
from derender.training import loop, train
from derender.training.config import resolve
from derender.training.step import training_step
from derender.training.watch import Watcher


class ReadBack(TorchDispatchMode):
    """Notes operators whose result the host waits for."""

    def __init__(self, seen: list[str]):
        super().__init__()
        self.seen = seen

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        waits = any(one in str(func) for one in ("_local_scalar_dense", "nonzero", "masked_select", "unique"))
        by_mask = "index" in str(func) and any(
            isinstance(index, torch.Tensor) and index.dtype == torch.bool
            for given in args if isinstance(given, (list, tuple)) for index in given
        )  # fmt: skip
        if waits or by_mask:
            self.seen.append(str(func))
        return func(*args, **(kwargs or {}))


class BroughtAnew(TorchFunctionMode):
    """Notes tensors made of numbers of the host."""

    def __init__(self, seen: list[str]):
        super().__init__()
        self.seen = seen

    def __torch_function__(self, func, types, args=(), kwargs=None):
        if getattr(func, "__name__", "") in ("tensor", "as_tensor", "new_tensor", "from_numpy"):
            self.seen.append(func.__name__)
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("loocc", ["none", "light+camera"])
def test_a_step_stays_on_its_device(loocc):
    config = resolve("small", ["image_size=32", "width=8", "light_width=4", f"loocc={loocc}"])
    model, vgg = Derenderer.seeded(config.model, 0), Vgg16Features()
    generator, images = torch.Generator().manual_seed(0), torch.rand(2, 3, 32, 32)
    for _ in range(2):  # what is brought once stays
        seen: list[str] = []
        with ReadBack(seen), BroughtAnew(seen):
            total = training_step(model, images, config.objective, vgg, generator).total
        total.backward()
    asked_of_the_cpu_alone = {"none": 0, "light+camera": 2}[loocc]  # whether LOOCC's choice is in range
    assert seen == ["aten._local_scalar_dense.default"] * asked_of_the_cpu_alone


def test_the_loop_reads_the_notes_of_many_steps_at_once(tmp_path, monkeypatch):
    """A whole step, with update and watcher; notes are read every 16 steps, and where a state is kept."""
    asked, read, looked = [], [], []
    step, read_notes, look = loop._Run.step, loop._Run.read_notes, Watcher.look

    def watched(run):
        asked.append([])
        with ReadBack(asked[-1]):
            return step(run)

    monkeypatch.setattr(loop._Run, "step", watched)
    monkeypatch.setattr(loop._Run, "read_notes", lambda run: read.append(len(run.notes)) or read_notes(run))
    monkeypatch.setattr(Watcher, "look", lambda self, at, *note: looked.append(at) or look(self, at, *note))
    tiny = ["image_size=32", "width=4", "light_width=4", "perceptual=none", "batch_size=2"]
    tiny += ["split=[0.8,0.2,0]", "images=40", "whitening.pictures=0", "fitting.examples=0"]
    train(resolve("small", tiny), noise_set(20), tmp_path / "run")
    assert not any(asked[1:])  # in the first step tables are made
    assert read == [16, 4] and looked == list(range(2, 42, 2))
