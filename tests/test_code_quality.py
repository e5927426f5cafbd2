"""ruff and pyrefly, in the versions that constraints.txt names; types and shapes are checked as tests run."""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import beartype
import jaxtyping
import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from derender.networks.encoders import stage_widths
from derender.training.step import fill_uncovered

ROOT = Path(__file__).resolve().parents[1]


def complaints(*command: str) -> str:
    """What a tool has to say about the checkout; empty when it is content."""
    words = [sys.executable, "-m", *command]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=250)
    return "" if done.returncode == 0 else f"{done.stdout}{done.stderr}"


def test_ruff_finds_nothing():
    assert not (result := complaints("ruff", "check", "--quiet", "--output-format=concise", ".")), result


def test_code_is_formatted():
    result = complaints("ruff", "format", "--quiet", "--diff", ".")
    assert not result, f"run: make format\n{result}"


def test_types_fit():
    how = ["--output-format=min-text", "--summary=none", "--python-interpreter-path", sys.executable]
    assert not (result := complaints("pyrefly", "check", *how)), result


def test_types_and_shapes_are_checked_as_tests_run():
    image, mask = torch.zeros(2, 3, 8, 8), torch.zeros(2, 8, 8)
    fill_uncovered(image, mask, image)
    for wrong in (mask[:1], mask[0], mask.long()):
        with pytest.raises(TypeError, match="mask"):
            fill_uncovered(image, wrong, image)
    with pytest.raises(TypeError, match="stages"):
        stage_widths(16, Any)  # pyright: ignore[reportArgumentType]

    checker = beartype.beartype(conf=beartype.BeartypeConf(violation_type=TypeError))

    @jaxtyping.jaxtyped(typechecker=checker)
    @dataclass
    class Pair:
        a: Float[Tensor, "n c"]
        b: Float[Tensor, "n"]

    with pytest.raises(TypeError, match="b="):
        Pair(torch.zeros(2, 3), torch.zeros(3))

    @jaxtyping.jaxtyped(typechecker=checker)
    def first(rows: Float[Tensor, "n c"]) -> Float[Tensor, "n c"]:
        return rows[:1]

    first(torch.zeros(1, 3))
    with pytest.raises(TypeError, match="return"):
        first(torch.zeros(2, 3))
