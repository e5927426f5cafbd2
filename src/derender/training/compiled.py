"""Networks compiled by torch.compile (inductor) if that makes steps faster; decided before the first one.

Compiled kernels round at other places: the choice belongs to the state of a run, which resumes as it began.
"""

import time
from collections.abc import Callable, Iterator

import torch
from torch import nn

TIMED = 4  # steps of either way that are timed, after a first one that may compile
SAME_LOSS = 0.02  # largest relative difference of the loss, as bfloat16 rounds


def compile_networks(
    model: nn.Module, step: Callable[[], float], report: Callable[[str], None], wanted: bool | None = None
) -> bool:
    """Compile a model's networks in place if steps are faster with it, or as ``wanted``; whether they are.

    Args:
        step: losses and gradients of one batch, to the loss; it changes no weights.
        report: is given a sentence once both ways were timed.
        wanted: what a resumed run began with; None decides.

    Raises:
        ValueError: compiled networks are wanted, and this machine cannot compile.
    """
    if wanted is False:
        return False
    eager, expected = (0.0, None) if wanted else _timed(step)
    with torch._dynamo.config.patch(recompile_limit=64):  # networks of one class share its code
        for network in networks_of(model):
            network.compile(dynamic=False)
        try:
            seconds, loss = _timed(step)
        except RuntimeError as error:  # no C++ compiler, or a kernel that cannot be built
            why = f"cannot be compiled ({str(error).strip().splitlines()[0]})"
        else:
            if expected is None:
                return True
            faster = eager / seconds
            why = f"are slower compiled ({faster:.2f} times the speed)"
            if not abs(loss - expected) <= SAME_LOSS * abs(expected):
                why = f"give another loss compiled ({loss:.6g} for {expected:.6g})"
            elif faster > 1:
                report(f"networks are compiled: steps are {faster:.2f} times as fast")
                return True
    if wanted:
        raise ValueError(f"this run began with compiled networks, which {why}: resume it with compile=off")
    for network in networks_of(model):
        network._compiled_call_impl = None
    report(f"networks are not compiled: they {why}")
    return False


def networks_of(module: nn.Module) -> Iterator[nn.Module]:
    """The outermost modules within one that have a forward of their own."""
    for child in module.children():
        if type(child).forward is nn.Module.forward:
            yield from networks_of(child)
        else:
            yield child


def _timed(step: Callable[[], float]) -> tuple[float, float]:
    """Seconds of the fastest step after the first, and its loss."""
    loss, seconds = step(), []
    for _ in range(TIMED):
        began = time.perf_counter()
        loss = step()
        seconds.append(time.perf_counter() - began)
    return min(seconds), loss
