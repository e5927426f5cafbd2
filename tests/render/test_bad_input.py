"""What cannot be rendered is refused in one sentence that says what was expected."""

import pytest
import torch

from derender.render import render, shade, warp
from derender.render.rasterize import rasterize

GOOD = {"depth": (2, 6, 5), "albedo": (2, 3, 6, 5), "light": (2, 4), "camera": (2, 6)}


@pytest.mark.parametrize(
    ("name", "shape", "message"),
    [
        ("depth", (6, 5), r"depth must have shape \(N, H, W\), got \(6, 5\)"),
        ("depth", (2, 1, 6, 5), r"depth must have shape \(N, H, W\), got \(2, 1, 6, 5\)"),
        ("depth", (2, 1, 5), "at least 2x2"),
        ("depth", (2, 6, 1), "at least 2x2"),
        ("albedo", (2, 3, 5, 6), r"albedo must have shape \(2, 3, 6, 5\) to fit depth, got \(2, 3, 5, 6\)"),
        ("albedo", (1, 3, 6, 5), r"albedo must have shape \(2, 3, 6, 5\) to fit depth, got \(1, 3, 6, 5\)"),
        ("albedo", (2, 1, 6, 5), r"albedo must have shape \(2, 3, 6, 5\) to fit depth, got \(2, 1, 6, 5\)"),
        ("light", (2, 3), r"light must have shape \(2, 4\) to fit depth, got \(2, 3\)"),
        ("camera", (2, 5), r"camera must have shape \(2, 6\) to fit depth, got \(2, 5\)"),
        ("camera", (3, 6), r"camera must have shape \(2, 6\) to fit depth, got \(3, 6\)"),
    ],
)
def test_wrong_shapes(name, shape, message):
    with pytest.raises(ValueError, match=message):
        render(**{key: torch.ones(size) for key, size in (GOOD | {name: shape}).items()})


@pytest.mark.parametrize("name", GOOD)
def test_integers_and_mixed_precision(name):
    inputs = {key: torch.ones(size) for key, size in GOOD.items()}
    with pytest.raises(ValueError, match=rf"{name} must be floating point, got torch.int64"):
        render(**inputs | {name: inputs[name].long()})
    with pytest.raises(ValueError, match=r"must all have one dtype, got .*float64"):
        render(**inputs | {name: inputs[name].double()})


def test_settings_and_parts():
    inputs = [torch.ones(size) for size in GOOD.values()]
    for fov_deg in (0.0, 180.0, -5.0):
        with pytest.raises(ValueError, match="fov_deg must lie between 0 and 180"):
            render(*inputs, fov_deg=fov_deg)
    with pytest.raises(ValueError, match="unknown render backend 'gpu'"):
        render(*inputs, backend="gpu")
    with pytest.raises(ValueError, match="image must have shape"):
        warp(torch.ones(2, 3, 4, 4), torch.ones(2, 6, 5), torch.zeros(2, 6))
    with pytest.raises(ValueError, match="light must have shape"):
        shade(torch.ones(2, 6, 5), torch.ones(2, 3, 6, 5), torch.zeros(4))
    with pytest.raises(ValueError, match="at least 2x2 vertices, got 1x4"):
        rasterize(torch.ones(1, 1, 4, 3), 10.0)
    with pytest.raises(ValueError, match="focal length must be positive"):
        rasterize(torch.ones(1, 4, 4, 3), 0.0)
    assert rasterize(torch.ones(1, 4, 4, 3), 0.5).depth.shape == (1, 4, 4)
