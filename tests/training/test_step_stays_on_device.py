"""A training step asks the host for nothing: no number is read back and none is brought anew.

Either would stop the device in every step, and neither can be part of a CUDA graph. Seen on the CPU, where
the same calls are made.
"""

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from derender.model import Derenderer
from derender.objectives import Vgg16Features
from derender.training.config import resolve
from derender.training.step import training_step


class ReadBack(TorchDispatchMode):
    """Notes operators whose result the host waits for."""

    def __init__(self, seen: list[str]):
        super().__init__()
        self.seen = seen

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if any(word in str(func) for word in ("_local_scalar_dense", "nonzero", "masked_select", "unique")):
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
