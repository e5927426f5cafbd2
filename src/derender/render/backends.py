"""Implementations of an operation: plain torch (the definition), Numba (CPU) or Triton (CUDA), one signature.

Which one runs, and the last two as torch operators with an analytic derivative. An operator's inputs are
tensors, images first, and a focal length in pixels. The first few outputs are differentiable; those of
integers are kept for the derivative. The derivative takes gradients, inputs, kept outputs and focal length.
Triton also runs on the CPU in its interpreter, slowly, for tests.
"""

import importlib
import importlib.util
import os
import shutil
import sysconfig
from collections.abc import Callable, Sequence
from math import inf
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from derender.render.triton_launch import interpreted

Operation = Callable[..., Any]
WORKS_ON = {"numba": "cpu", "triton": "cuda"}
INSTALLED = {name: importlib.util.find_spec(name) is not None for name in WORKS_ON}
"""Found at import, as torch 2.6 cannot trace it."""
BACKENDS = ("auto", "reference", *WORKS_ON)
FEW_PIXELS = 4 * 64 * 64  # without gradients the reference's on a CPU: Numba takes half a second to start


def available_backends() -> tuple[str, ...]:
    """Names that ``backend=`` accepts on this machine, besides ``auto``; ``triton`` for its GPU."""
    runs = {"numba": True, "triton": torch.cuda.is_available() or interpreted()}
    return ("reference", *(name for name in WORKS_ON if INSTALLED[name] and runs[name]))


def chosen_backend(device: torch.device | str, backend: str = "auto", pixels: float = inf) -> str:
    """The implementation that ``backend`` means for tensors on ``device``; an impossible one is an error.

    ``pixels``: of all images together.
    """
    kind = torch.device(device).type
    if backend not in BACKENDS:
        raise ValueError(f"unknown render backend {backend!r}; choose one of {', '.join(BACKENDS)}")
    if backend == "auto":
        if kind == "cpu" and pixels <= FEW_PIXELS and not torch.is_grad_enabled():
            return "reference"
        usable = {**INSTALLED, "triton": INSTALLED["triton"] and (interpreted() or _launches())}
        return next((name for name, works in WORKS_ON.items() if works == kind and usable[name]), "reference")
    if backend == "reference":
        return backend
    if not INSTALLED[backend]:
        lacks = f"the {backend} render backend needs the package {backend}"
        raise ValueError(f"{lacks}; install it or use 'reference'")
    if kind != WORKS_ON[backend] and not (backend == "triton" and interpreted()):
        where = "the CPU" if backend == "numba" else "a CUDA device"
        slowly = ", or set TRITON_INTERPRET=1 before Python starts to try it on the CPU, slowly"
        wrong = f"the {backend} render backend works on {where}, the tensors are on {kind}"
        raise ValueError(f"{wrong}; use 'auto'{slowly * (backend == 'triton')}")
    return backend


def _launches() -> bool:
    """Whether Triton finds what it builds its launcher with: a C compiler and Python's header."""
    compiler = "CC" in os.environ or any(shutil.which(name) for name in ("gcc", "clang"))
    return compiler and Path(sysconfig.get_paths()["include"], "Python.h").is_file()


def operators(
    name: str, package: str, inputs: Sequence[str], room: Operation, differentiable: int, triton: Operation,
    triton_backward: Operation,
) -> dict[str, Operation]:  # fmt: skip
    """By backend the operator ``derender::{name}_{backend}``.

    Numba's kernels are ``forward`` and ``backward`` in package/numba_kernels.py: each takes the arrays of the
    operator's tensors, the focal length, those of the results, and a range of images. ``room`` makes empty
    outputs for input tensors. Fast kernels are imported, and compiled, on the first call.
    """
    outputs = room(*(torch.empty((1, 1, 2, 2), device="meta") for _ in inputs))
    kept = [f"kept_{number}" for number, value in enumerate(outputs) if not value.is_floating_point()]
    grads = [f"grad_{number}" for number in range(differentiable)]

    def gradients(*values: Tensor) -> tuple[Tensor, ...]:
        return tuple(value.new_empty(value.shape) for value in values[differentiable:][: len(inputs)])

    def in_numba(direction: str, room: Operation) -> Operation:
        def run(*values: Any) -> Any:
            from derender.render.numba_threads import array, over_images

            kernel = getattr(importlib.import_module(f"derender.render.{package}.numba_kernels"), direction)
            *tensors, focal_px = values
            results = room(*tensors)
            over_images(kernel, len(tensors[0]), *map(array, tensors), focal_px, *map(array, results))
            return _one_or_all(results)

        return run

    def registered(
        backend: str, devices: str | Sequence[str], run: Operation, run_backward: Operation
    ) -> Operation:
        def made(
            suffix: str, tensors: Sequence[str], results: int, function: Operation, room: Operation
        ) -> Any:
            takes, gives = ", ".join(f"Tensor {one}" for one in tensors), ", ".join(["Tensor"] * results)
            whole, schema = f"derender::{name}_{backend}{suffix}", f"({takes}, float focal_px) -> ({gives})"
            torch.library.define(whole, schema, tags=torch.Tag.pt2_compliant_tag)
            torch.library.impl(whole, devices)(function)
            torch.library.register_fake(whole, lambda *values: _one_or_all(room(*values[:-1])))
            return getattr(torch.ops.derender, f"{name}_{backend}{suffix}").default

        def keep(ctx: Any, inputs: tuple, output: Any) -> None:
            *values, ctx.focal_px = inputs
            results = (output,) if isinstance(output, Tensor) else output
            ctx.mark_non_differentiable(*results[differentiable:])
            ctx.save_for_backward(*values, *(value for value in results if not value.is_floating_point()))

        def differentiate(ctx: Any, *given: Tensor) -> tuple[Tensor | None, ...]:
            return *derivative(*given[:differentiable], *ctx.saved_tensors, ctx.focal_px), None

        operator = made("", inputs, len(outputs), run, room)
        derivative = made("_backward", [*grads, *inputs, *kept], len(inputs), run_backward, gradients)
        torch.library.register_autograd(operator, differentiate, setup_context=keep)
        return operator

    return {
        "numba": registered("numba", "cpu", in_numba("forward", room), in_numba("backward", gradients)),
        "triton": registered("triton", ("cuda", "cpu"), triton, triton_backward),
    }


def _one_or_all(values: Sequence[Tensor]) -> Any:
    return values[0] if len(values) == 1 else values
