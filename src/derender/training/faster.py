"""Two ways to make training steps faster, each timed on the steps of the run and left where it is slower.

Networks are compiled by torch.compile (inductor): decided before the first step, for compiled kernels round
at other places. So the choice belongs to the state of a run, which resumes as it began. On a GPU a step is
recorded once as a CUDA graph and replayed: the host launches it whole, not by kernels. These take
microseconds each, so that a step waits for the host most of the time. Replayed or not it runs the same
kernels and gives the same bits: a run may change between them, and resumes exactly.
"""

import time
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Generator, Tensor, nn

TRIED = 4  # steps with networks compiled or not that are timed, after a first one that may compile
SAME_LOSS = 0.02  # largest relative difference of the loss, as bfloat16 rounds
WARMING = 16  # ordinary steps before the clock of replaying runs; kernels are compiled in them
TIMED = 16  # steps, replayed or not, that are timed


def compile_networks(
    model: nn.Module, step: Callable[[], float], report: Callable[[str], None], wanted: bool | None = None
) -> bool:
    """Compile a model's networks in place if steps are faster with it, or as ``wanted``; whether they are.

    ``step`` computes losses and gradients of one batch, to the loss, and changes no weights; ``report`` is
    given a sentence once both ways were timed. ``wanted`` is what a resumed run began with; None decides. A
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
    for _ in range(TRIED):
        began = time.perf_counter()
        loss = step()
        seconds.append(time.perf_counter() - began)
    return min(seconds), loss


class Replayed:
    """A training step that is replayed from some call on, if that is faster.

    ``update`` is the step: images (N, 3, H, W) of a batch and the share of the run that is done, to its
    result and a tensor of notes. It never waits for the device, and draws from ``noise`` alone, a generator
    on the device, seeded anew before each call. ``report`` is given a sentence once both ways were timed.
    """

    def __init__(
        self, update: Callable[[Tensor, float], tuple[Any, Tensor]], noise: Generator,
        report: Callable[[str], None],
    ):  # fmt: skip
        self.update, self.noise, self.report = update, noise, report
        self._wanted = True
        self._stream = torch.cuda.Stream(noise.device)
        self._graph: Any = None
        self._kept: Any = None
        self._phase: Any = None
        self._calls, self._seconds = 0, [0.0, 0.0]

    def __call__(self, images: Tensor, done: float, phase: Any) -> tuple[Any, Tensor]:
        """Result and notes of a step; a graph is recorded for each ``phase``, none for None."""
        usual = torch.cuda.current_stream(images.device)
        self._stream.wait_stream(usual)
        with torch.cuda.stream(self._stream):
            if phase is None or not self._wanted:
                result = self.update(images, done)
            else:
                result = self._either(images, done, phase)
        usual.wait_stream(self._stream)
        return result

    def _either(self, images: Tensor, done: float, phase: Any) -> tuple[Any, Tensor]:
        """The step in one way, timed where the choice is still open."""
        self._calls += 1
        way, timed = divmod(self._calls - WARMING - 1, TIMED)
        if way > 0 and phase != self._phase:
            self._record(images, done, phase)
        step = self.update if self._graph is None else self._replay
        if way not in (0, 1):
            return step(images, done)
        torch.cuda.synchronize()
        began = time.perf_counter()
        result = step(images, done)
        torch.cuda.synchronize()
        self._seconds[way] += time.perf_counter() - began
        if (way, timed) == (1, TIMED - 1) and self._graph is not None:
            faster = self._seconds[0] / self._seconds[1]
            if faster < 1:
                self._leave(f"is slower ({faster:.2f} times the speed)")
            else:
                self.report(f"steps are replayed as a CUDA graph, {faster:.1f} times as fast")
        return result

    def _record(self, images: Tensor, done: float, phase: Any) -> None:
        self._graph, self._phase, self._images = torch.cuda.CUDAGraph(), phase, images.clone()
        self._graph.register_generator_state(self.noise)
        try:
            with torch.cuda.graph(self._graph, stream=self._stream):
                self._kept = self.update(self._images, done)
        except RuntimeError as error:  # no memory for it, or a kernel that cannot be recorded
            self._leave(f"could not be recorded ({str(error).splitlines()[0]})")

    def _replay(self, images: Tensor, done: float) -> tuple[Any, Tensor]:
        self._images.copy_(images)
        self._graph.replay()
        result, notes = self._kept
        return result, notes.clone()  # the next replay overwrites the result

    def _leave(self, why: str) -> None:
        self._graph, self._kept, self._wanted = None, None, False
        self.report(f"steps are launched one by one: a CUDA graph {why}")
