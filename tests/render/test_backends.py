"""The fast implementations against the definition, and as good citizens of torch, threads and processes."""

import math
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from tests.render.devices import FAST, device_of, rasterize, render, shade, warp
from tests.render.scenes import FOV_DEG, scene
from tests.tolerances import assert_agrees
from torch import Tensor

from derender.render import available_backends, backends, chosen_backend
from derender.render.backends import INSTALLED
from derender.render.rasterize import CHOOSE, reference
from derender.render.warping import FORWARD, sample
from derender.scene.camera import focal_px, motion, to_camera, unproject

fast = pytest.mark.parametrize("backend", FAST)
needs_numba = pytest.mark.skipif("numba" not in available_backends(), reason="numba is not installed")


@pytest.fixture
def nan_filled_memory():
    """Memory handed out uninitialised holds NaN (and the largest integer) until the end of the test."""
    torch.use_deterministic_algorithms(True)
    assert torch.utils.deterministic.fill_uninitialized_memory
    assert torch.empty(3).isnan().all()


def assert_agrees_with_reference(fast_backend: str, values: tuple[Tensor, ...], function=render) -> None:
    """Outputs, and the gradient of each input."""
    kept = []
    for backend in ("reference", fast_backend):
        inputs = [value.clone().requires_grad_() for value in values]
        result, cotangents = function(*inputs, FOV_DEG, backend), torch.Generator().manual_seed(1)
        outputs = (result.image, result.depth)
        weights = [torch.randn(value.shape, generator=cotangents, dtype=value.dtype) for value in outputs]
        kept.append((*outputs, *torch.autograd.grad(outputs, inputs, weights), result.mask))
        assert not result.mask.requires_grad
        for value, original in zip(inputs, values, strict=True):
            assert torch.equal(value, original), "inputs must not be written to"
    assert torch.equal(kept[0][-1], kept[1][-1])
    for number, (expected, actual) in enumerate(zip(*kept, strict=True)):
        assert_agrees(actual, expected, f"output or gradient {number}")


@fast
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("count", "height", "width"), [(3, 17, 23), (1, 31, 12), (2, 2, 2), (5, 3, 9), (1, 48, 48)]
)
def test_backends_agree(backend, count, height, width, dtype, generator, nan_filled_memory):
    assert_agrees_with_reference(backend, scene(count, height, width, generator, dtype))


@fast
@pytest.mark.parametrize("degrees", [70, 85, 89, 89.9])
@pytest.mark.parametrize("axis", [0, 1])
def test_backends_agree_at_grazing_angles(backend, degrees, axis, generator, nan_filled_memory):
    *maps, pose = scene(2, 16, 21, generator, torch.float64)
    pose[:, axis] = math.radians(degrees)
    assert_agrees_with_reference(backend, (*maps, pose))


@fast
def test_backends_agree_on_rough_depth_with_many_layers(backend, generator):
    _, *others = scene(4, 19, 16, generator, torch.float64, turn_rad=math.pi)
    depth = 0.9 + 0.2 * torch.rand(4, 19, 16, generator=generator, dtype=torch.float64)
    assert_agrees_with_reference(backend, (depth, *others))


@fast
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_backends_choose_the_same_triangle(backend, dtype, generator):
    """Bit for bit, ties of the identity camera and of exact half pixels included."""
    depth, _, _, pose = scene(6, 20, 17, generator, dtype, turn_rad=1.5)
    pose[0] = 0
    pose[1] = 0
    depth[1] = 1
    pose[1, 3] = 0.5 / focal_px(17, FOV_DEG)
    vertices, focal = to_camera(unproject(depth, FOV_DEG), pose), focal_px(17, FOV_DEG)
    screen = reference.project(vertices.double(), focal)
    expected = reference.visible_triangles(screen)
    assert (expected >= 0).float().mean() > 0.2
    assert torch.equal(CHOOSE[backend](screen.to(device_of(backend))).cpu().long(), expected)


def test_reference_gives_the_same_in_small_portions(generator, monkeypatch):
    depth, _, _, pose = scene(3, 12, 10, generator)
    vertices = to_camera(unproject(depth, FOV_DEG), pose)
    whole = rasterize(vertices, focal_px(10, FOV_DEG), "reference")
    monkeypatch.setattr(reference, "PAIRS_AT_ONCE", 37)
    parts = rasterize(vertices, focal_px(10, FOV_DEG), "reference")
    assert torch.equal(parts.uv, whole.uv)
    assert torch.equal(parts.depth, whole.depth)


@fast
@pytest.mark.parametrize("channels", [1, 3, 5])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_warping_agrees_for_any_number_of_channels(backend, channels, dtype, generator, nan_filled_memory):
    depth, _, _, pose = scene(2, 5, 8, generator, dtype)
    image = torch.randn(2, channels, 5, 8, generator=generator, dtype=dtype)
    assert_agrees_with_reference(backend, (image, depth, pose), warp)


def test_sampling_is_exact_on_bilinear_images_and_at_pixels(generator):
    v, u = torch.meshgrid(torch.arange(5.0), torch.arange(8.0), indexing="ij")
    image = (2 * u - 3 * v + 0.5 * u * v + 1)[None, None].double()
    uv = torch.rand(1, 9, 6, 2, generator=generator, dtype=torch.float64) * torch.tensor([7.0, 4.0])
    expected = 2 * uv[..., 0] - 3 * uv[..., 1] + 0.5 * uv[..., 0] * uv[..., 1] + 1
    assert_agrees(sample(image, uv, torch.ones(1, 9, 6).double())[:, 0], expected)
    at_pixels = torch.stack((u, v), -1)[None].double()
    assert torch.equal(sample(image, at_pixels, torch.ones(1, 5, 8).double()), image)


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf")  # torch 2.15's own
@fast
def test_operators_keep_torch_s_rules(backend, generator):
    operators, device = torch.ops.derender, device_of(backend)
    depth, albedo, _, pose = (value.to(device) for value in scene(2, 5, 6, generator))
    rotation, offset = motion(pose.double())
    _, distance, _, triangle = FORWARD[backend](albedo, depth, rotation, offset, 20.0)
    picture = torch.randn(2, 3, 5, 6, generator=generator).to(device)
    lamp = torch.rand(2, 5, generator=generator).to(device)
    shaded, warped = (depth, albedo, lamp, 20.0), (albedo, depth, rotation, offset)
    checks = {"shade": shaded, "shade_backward": (picture, *shaded), "warp": (*warped, 20.0)}
    checks["warp_backward"] = (picture, distance.detach(), *warped, triangle, 20.0)
    for name, values in checks.items():
        operator, _, direction = name.partition("_")
        whole_name = f"{operator}_{backend}{'_' * bool(direction)}{direction}"
        if not direction:
            values = [v.detach().requires_grad_() if isinstance(v, Tensor) else v for v in values]
        torch.library.opcheck(getattr(operators, whole_name).default, tuple(values))


@fast
def test_compiles_without_graph_breaks_and_works_in_a_forked_process(backend):
    """In a process of its own: the type checks of the test run are Python that torch.compile cannot trace.

    There importing the renderer imports no compiler.
    """
    code = f"""
import os, signal, sys, torch
from derender.render.rasterize import rasterize
assert not {{"numba", "triton"}} & {{*sys.modules}}
from derender.scene.camera import focal_px, unproject
if {backend!r} == "numba" and hasattr(os, "fork"):
    torch.set_num_threads(2)
    points = unproject(torch.ones(4, 5, 5), 10.0)
    expected = rasterize(points, focal_px(5, 10.0), "numba").depth
    child = os.fork()
    if child == 0:
        signal.alarm(60)
        same = torch.equal(rasterize(points, focal_px(5, 10.0), "numba").depth, expected)
        os._exit(0 if same else 1)
    assert os.waitpid(child, 0)[1] == 0
from derender.render import render
def loss(*inputs):
    result = render(*inputs, 10.0, {backend!r})
    return result.image.square().sum() + result.depth.sum()
values = (1 + 0.01 * torch.rand(2, 7, 6), torch.rand(2, 3, 7, 6), torch.rand(2, 4), 0.2 * torch.rand(2, 6))
inputs = [value.to({device_of(backend)!r}).requires_grad_() for value in values]
compiled = torch.compile(loss, backend="aot_eager", fullgraph=True)
expected, actual = (torch.autograd.grad(function(*inputs), inputs) for function in (loss, compiled))
for one, other in zip(expected, actual, strict=True):
    torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5 * float(one.abs().max()))
"""
    assert subprocess.run([sys.executable, "-c", code], timeout=280, check=False).returncode == 0


@needs_numba
def test_memory_layout_does_not_matter(generator):
    depth, albedo, light, pose = scene(2, 9, 8, generator)
    image = shade(depth, albedo, light, FOV_DEG)
    expected = warp(image, depth, pose, FOV_DEG, "numba").image
    swapped = image.contiguous(memory_format=torch.channels_last)
    strided = depth.transpose(1, 2).contiguous().transpose(1, 2)
    assert torch.equal(warp(swapped, strided, pose, FOV_DEG, "numba").image, expected)


@needs_numba
def test_threads_change_nothing(generator):
    """One or two threads inside, and several Python threads outside."""
    values, threads = scene(7, 12, 11, generator), torch.get_num_threads()

    def job(_: int) -> Tensor:
        inputs = [value.clone().requires_grad_() for value in values]
        return torch.autograd.grad(render(*inputs, FOV_DEG, "numba").image.square().sum(), inputs)[0]

    try:
        torch.set_num_threads(1)
        expected = job(0)
        torch.set_num_threads(2)
        with ThreadPoolExecutor(4) as pool:
            results = list(pool.map(job, range(12)))
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(result, expected) for result in results)


@needs_numba
def test_kernels_are_compiled_where_no_folder_can_cache_them():
    from derender.render.numba_threads import kernel

    namespace = {"kernel": kernel}
    code = "@kernel\ndef count(values, start, stop):\n    values[start:stop] += 1"
    exec(code, namespace)  # no file, no cache
    values = torch.zeros(5, dtype=torch.float64)
    namespace["count"](values.numpy(), 1, 4)
    assert values.tolist() == [0, 1, 1, 1, 0]


def test_auto_takes_the_fastest_that_is_installed(monkeypatch):
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    cases = ((True, True, "numba", "triton"), (True, False, "numba", "reference"))
    for installed, compiler, on_cpu, on_cuda in (*cases, (False, True, "reference", "reference")):
        monkeypatch.setattr(backends, "_launches", lambda found=compiler: found)
        for name in INSTALLED:
            monkeypatch.setitem(INSTALLED, name, installed)
        assert chosen_backend("cpu") == chosen_backend(torch.device("cpu"), "auto") == on_cpu
        assert chosen_backend("cuda:0") == on_cuda
        assert chosen_backend("mps") == "reference"
        assert chosen_backend("cuda:0", "reference") == "reference"
    assert available_backends() == ("reference",)
    for backend, device in (("numba", "cpu"), ("triton", "cuda")):
        with pytest.raises(ValueError, match=f"needs the package {backend}; install it"):
            chosen_backend(device, backend)


@pytest.mark.parametrize(
    ("device", "backend", "message"),
    [
        ("cpu", "fast", "unknown render backend 'fast'; choose one of auto, reference, numba, triton"),
        ("cpu", "triton", "works on a CUDA device, the tensors are on cpu; use 'auto'"),
        ("cuda", "numba", "works on the CPU, the tensors are on cuda"),
    ],
)
def test_impossible_backends_are_errors(device, backend, message, monkeypatch):
    for name in INSTALLED:
        monkeypatch.setitem(INSTALLED, name, True)
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    with pytest.raises(ValueError, match=message):
        chosen_backend(device, backend)
