"""Fixtures every test may use: development data beside the checkout, seeds, tolerances."""

import dataclasses
import gc
import inspect
import os
from collections.abc import Callable
from functools import lru_cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any, get_args

import jaxtyping
import numpy as np
import pytest
import torch

ROOT = Path(__file__).resolve().parents[1]
LONGEST = ("test_readers_refuse_what_is_broken", "test_two_processes")
LONGEST += ("test_what_fails_in_all_processes",)  # with the two processes of those before
LONGEST += ("test_a_kill_at_any_step",)  # which forks: the sooner, the smaller a process is copied
gc.disable()  # until all is imported, which then stays: no collection looks at it again

_JAXTYPED = jaxtyping.jaxtyped


def shaped(hint: Any) -> bool:
    """Whether a type is, or contains, that of an array of some shape."""
    own = inspect.isclass(hint) and issubclass(hint, jaxtyping.AbstractArray)
    return own or any(map(shaped, get_args(hint)))


def checked(fn: Any = None, *, typechecker: Callable) -> Any:
    """jaxtyping's decorator, only where shapes have to agree; elsewhere the type checker, once a call."""
    if fn is None:
        return partial(checked, typechecker=typechecker)
    if inspect.isclass(fn):
        if dataclasses.is_dataclass(fn):
            fn.__init__ = checked(fn.__init__, typechecker=typechecker)
        return fn
    hints = fn.__annotations__.values()
    if any(isinstance(hint, str) for hint in hints):  # perhaps of a module that is not imported here
        return _JAXTYPED(fn, typechecker=typechecker)
    once = typechecker(fn)
    return _JAXTYPED(once, typechecker=None) if any(map(shaped, hints)) else once


jaxtyping.jaxtyped = checked  # which the import hook puts around all functions


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest tests begin first, so that no worker ends with one alone."""
    gc.freeze()
    gc.enable()
    gc.set_threshold(10_000)
    items.sort(key=lambda item: not item.name.startswith(LONGEST))


def shared_folder() -> Path | None:
    """Where the development data lies: $DERENDER_SHARED, or ``shared`` beside the checkout, or None."""
    folder = Path(os.environ.get("DERENDER_SHARED", ROOT.parent / "shared"))
    return folder if folder.is_dir() else None


@pytest.fixture(scope="session")
def shared_data():
    """``shared_data("data/utkface64.zip")`` gives the path, or skips the test and says what is missing."""

    def find(name: str) -> Path:
        folder = shared_folder()
        if folder is None or not (folder / name).exists():
            pytest.skip(f"development data {name} is not here (set DERENDER_SHARED to the folder of it)")
        return folder / name

    return find


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def made_smallest():
    """An untrained model of the smallest kind, for 32 pixels."""
    from derender import Derenderer  # late: its types are checked from when pytest is set up

    return Derenderer.from_preset("small", seed=0, image_size=32, width=4, light_width=4)


@pytest.fixture
def smallest():
    return made_smallest()


@pytest.fixture(scope="session")
def tiny(tmp_path_factory) -> Path:
    """The smallest model, saved."""
    return made_smallest().save(tmp_path_factory.mktemp("tiny") / "model")


@pytest.fixture(scope="session", autouse=True)
def _started_and_searched_once():
    """Numba, started, renders few pixels, too; the detector of faces answers again for pixels it has seen."""
    module = import_module("derender.photo.faces")
    search = module._detected
    detected = lru_cache(128)(lambda data, shape, *of: search(np.frombuffer(data, "u1").reshape(shape), *of))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("derender.render.backends.FEW_PIXELS", 0)
        patch.setattr(module, "_detected", lambda one, *of: list(detected(one.tobytes(), one.shape, *of)))
        yield


@pytest.fixture(autouse=True)
def _restore_determinism():
    """A run with ``deterministic=true`` leaves torch as it was."""
    yield
    if torch.are_deterministic_algorithms_enabled():  # else the call would only import torch's compiler
        torch.use_deterministic_algorithms(False)
