"""The Triton kernels without a GPU, in Triton's interpreter, and the integer sums that make gradients repeat.

The interpreter must be chosen before Triton is imported, so it gets a process of its own. With a GPU, or with
TRITON_INTERPRET=1 in the environment, every test of this folder that takes a backend runs on Triton as well.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from tests.render.devices import render
from tests.render.scenes import FOV_DEG, scene
from tests.tolerances import assert_agrees

from derender.render import available_backends, triton_launch
from derender.render.backends import INSTALLED
from derender.render.triton_launch import ADD, ADD_INTEGERS, MEASURE, interpreted, scattered_sums

ROOT = Path(__file__).resolve().parents[2]
INTERPRETED = (
    "test_backends.py::test_backends_agree[3-17-23-dtype0-triton]",
    "test_backends.py::test_backends_agree[5-3-9-dtype1-triton]",
    "test_backends.py::test_backends_choose_the_same_triangle[dtype1-triton]",
    "test_backends.py::test_warping_agrees_for_any_number_of_channels[dtype0-3-triton]",
    "test_triton.py::test_several_programs_for_an_image_change_nothing",
    "test_triton.py::test_where_nothing_is_added_repeatable_gradients_are_nothing",
)


@pytest.mark.skipif(not INSTALLED["triton"], reason="triton is not installed")
@pytest.mark.skipif("triton" in available_backends(), reason="Triton runs in this very process")
def test_kernels_agree_with_the_definition_in_the_interpreter():
    tests = [f"tests/render/{name}" for name in INTERPRETED]
    call = subprocess.run(
        [sys.executable, "-m", "pytest", "-n", "0", "-p", "no:cacheprovider", *tests],
        cwd=ROOT, env={**os.environ, "TRITON_INTERPRET": "1"}, capture_output=True, text=True, timeout=280,
        check=False,
    )  # fmt: skip
    assert call.returncode == 0, call.stdout[-3000:] + call.stderr[-1000:]
    assert f"{len(INTERPRETED)} passed" in call.stdout


@pytest.mark.skipif(not (INSTALLED["triton"] and interpreted()), reason="needs TRITON_INTERPRET=1")
def test_several_programs_for_an_image_change_nothing(monkeypatch, generator):
    """In the interpreter one program has room for a whole small image; on a GPU many share it."""
    monkeypatch.setattr(triton_launch, "INTERPRETED_BLOCK", 16)
    values, kept = scene(2, 4, 5, generator, torch.float64), []
    for backend in ("reference", "triton"):
        inputs = [value.clone().requires_grad_() for value in values]
        result = render(*inputs, FOV_DEG, backend)
        gradients = torch.autograd.grad(result.image.square().sum() + result.depth.square().sum(), inputs)
        kept.append((result.image, result.depth, *gradients))
    for expected, actual in zip(*kept, strict=True):
        assert_agrees(actual, expected)


@pytest.fixture
def deterministic():
    torch.use_deterministic_algorithms(True)  # until the end of the test


def gradients_of(values, backend: str, columns: int) -> tuple[torch.Tensor, ...]:
    """Of a loss on the left columns of the image."""
    inputs = [value.clone().requires_grad_() for value in values]
    seen = render(*inputs, FOV_DEG, backend).image[..., :columns]
    return torch.autograd.grad(seen.square().sum(), inputs)


@pytest.mark.skipif("triton" not in available_backends(), reason="needs a GPU, or TRITON_INTERPRET=1")
def test_gradients_repeat_bit_for_bit_where_asked_for(generator, deterministic):
    values = scene(2, 33, 40, generator)
    one, other = (gradients_of(values, "triton", 40) for _ in range(2))
    assert all(torch.equal(first, second) for first, second in zip(one, other, strict=True))


@pytest.mark.skipif("triton" not in available_backends(), reason="needs a GPU, or TRITON_INTERPRET=1")
def test_where_nothing_is_added_repeatable_gradients_are_nothing(generator):
    values = scene(1, 6, 9, generator)
    right = gradients_of(values, "reference", 3)[:2]
    torch.use_deterministic_algorithms(True)
    result = gradients_of(values, "triton", 3)[:2]
    for expected, actual in zip(right, result, strict=True):
        assert (expected == 0).any() and (actual[expected == 0] == 0).all()
        assert_agrees(actual, expected)


def adding(values: torch.Tensor, order: torch.Tensor):
    """What a kernel does that adds each image's values (N, H, W) into one number, in some order."""

    def run(mode, units, largest, targets) -> None:
        for n, summands in enumerate(values.flatten(1)[:, order].double()):
            if mode == MEASURE:
                largest[n, 0] = max(triton_launch.float64_bits(abs(float(summand))) for summand in summands)
                continue
            for summand in summands:
                whole = mode == ADD_INTEGERS
                targets[0][n] += torch.floor(summand * units[n, 0] + 0.5).long() if whole else summand
                assert mode in (ADD, ADD_INTEGERS)

    return run


@pytest.mark.parametrize("shape", [(3,), (3, 2, 2)])
@pytest.mark.parametrize("scale", [1.0, 1e-200, 1e200])
def test_integer_sums_have_no_order_and_lose_nothing_that_counts(scale, shape, generator, deterministic):
    values = torch.randn(3, 4, 5, generator=generator, dtype=torch.float64) * scale
    values[0] = 0
    values[2] *= 1e-9  # each image by a unit of its own
    orders = [torch.randperm(20, generator=generator) for _ in range(2)]
    kernels = (adding(values, order) for order in orders)
    one, other = (scattered_sums(kernel, values, [shape], [torch.float64])[0] for kernel in kernels)
    assert torch.equal(one, other) and (one[0] == 0).all()
    torch.use_deterministic_algorithms(False)
    expected = scattered_sums(adding(values, orders[0]), values, [shape], [torch.float64])[0]
    for sums, right, summands in zip(one, expected, values, strict=True):
        assert torch.allclose(sums, right, rtol=0, atol=1e-15 * 20 * float(summands.abs().max()))


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_a_summand_that_is_not_finite_spoils_its_own_image_alone(bad, deterministic):
    values = torch.ones(2, 2, 2)
    values[1, 0, 1] = bad
    sums = scattered_sums(adding(values, torch.arange(4)), values, [(2,)], [torch.float32])[0]
    assert sums[0] == 4 and sums[1].isnan()
