"""The renderer called with tensors of the CPU, whatever device the backend asked for works on.

Triton works on the GPU, or, with TRITON_INTERPRET=1, on the CPU in its interpreter. Inputs are moved there
and results back, gradients included, so that a test need not know.
"""

import dataclasses
import os
from collections.abc import Callable
from functools import wraps
from typing import Any

from torch import Tensor

from derender import render as renderer
from derender.render import available_backends
from derender.render.rasterize import rasterize as rasterize_there

FAST = tuple(name for name in available_backends() if name != "reference")


def device_of(backend: str) -> str:
    return "cuda" if backend == "triton" and os.environ.get("TRITON_INTERPRET") != "1" else "cpu"


def moved(value: Any, device: str) -> Any:
    """Tensors, and dataclasses and tuples of them, on another device; anything else as it is."""
    if isinstance(value, Tensor):
        return value.to(device)
    if isinstance(value, tuple):
        return tuple(moved(part, device) for part in value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        parts = {field.name: moved(getattr(value, field.name), device) for field in dataclasses.fields(value)}
        return dataclasses.replace(value, **parts)
    return value


def there_and_back(function: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        backend = named.get("backend", next((a for a in reversed(arguments) if isinstance(a, str)), "auto"))
        if device_of(backend) == "cpu":
            return function(*arguments, **named)
        here = [moved(argument, device_of(backend)) for argument in arguments]
        return moved(function(*here, **{k: moved(v, device_of(backend)) for k, v in named.items()}), "cpu")

    return call


render, render_scene = there_and_back(renderer.render), there_and_back(renderer.render_scene)
shade, warp = there_and_back(renderer.shade), there_and_back(renderer.warp)
rasterize = there_and_back(rasterize_there)
