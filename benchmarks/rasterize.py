"""Rasteriser and renderer on the CPU: Numba against the plain torch definition, both ways, in one run.

First checks that both agree in outputs and gradients on the benchmark's own input, then times them in turns
(best of several, so that a busy machine disturbs least) and prints milliseconds per image and the ratio.

    python benchmarks/rasterize.py --size 64 --batch 64 --json rasterize.json
"""

import time
from collections.abc import Callable

import torch
from machine import parser, publish
from torch import Tensor
from torch.nn.functional import avg_pool2d

from derender.render import render, shade, warp
from derender.render.rasterize import rasterize
from derender.scene.camera import focal_px, to_camera, unproject

FOV_DEG = 10.0
BACKENDS = ("reference", "numba")
AGREEMENT = 1e-5


def surfaces(batch: int, size: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rolling depth, random colours, light and cameras as wide as synface64's."""
    draw = torch.Generator().manual_seed(0)
    noise = torch.randn(batch, 1, size + 4, size + 4, generator=draw)
    depth = 1 + 0.02 * avg_pool2d(noise, 5, 1)[:, 0]
    albedo = torch.rand(batch, 3, size, size, generator=draw)
    light = torch.rand(batch, 4, generator=draw) * torch.tensor([0.5, 0.5, 1.0, 1.0]) + 0.2
    spread = torch.tensor([0.14, 0.31, 0.07, 0.0035, 0.0035, 0.0])
    return depth, albedo, light, torch.randn(batch, 6, generator=draw) * spread


def best_ms(jobs: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """The shortest of several runs of each job, the jobs taking turns, after one run to warm up."""
    best = dict.fromkeys(jobs, float("inf"))
    for job in jobs.values():
        job()
    for _ in range(repeats):
        for name, job in jobs.items():
            start = time.perf_counter()
            job()
            best[name] = min(best[name], 1e3 * (time.perf_counter() - start))
    return best


def check(results: dict[str, tuple[Tensor, ...]]) -> float:
    """Largest difference between the two backends relative to the largest value, or an end with a reason."""
    worst = 0.0
    for expected, actual in zip(results["reference"], results["numba"], strict=True):
        worst = max(worst, float((actual - expected).abs().max() / expected.abs().max()))
    if not worst <= AGREEMENT:
        raise SystemExit(f"the backends differ by {worst:.3g} (allowed {AGREEMENT}): nothing was timed")
    return worst


def first_call_s() -> float:
    """Compiling the kernels, or reading them from Numba's cache, plus one tiny run."""
    start = time.perf_counter()
    points = unproject(torch.ones(1, 4, 4), FOV_DEG).requires_grad_()
    seen = rasterize(points, focal_px(4, FOV_DEG), "numba")
    (seen.uv.sum() + seen.depth.sum()).backward()
    return time.perf_counter() - start


def main() -> None:
    asks = parser(__doc__)
    asks.add_argument("--size", type=int, default=64, help="height and width in pixels")
    asks.add_argument("--batch", type=int, default=64, help="images per call")
    asks.add_argument("--threads", type=int, default=torch.get_num_threads(), help="CPU threads")
    asks.add_argument("--repeats", type=int, default=10, help="runs of which the best counts")
    arguments = asks.parse_args()
    torch.set_num_threads(arguments.threads)
    compile_s = first_call_s()

    depth, albedo, light, camera = surfaces(arguments.batch, arguments.size)
    focal = focal_px(arguments.size, FOV_DEG)
    vertices = to_camera(unproject(depth, FOV_DEG), camera).requires_grad_()
    scene = [value.requires_grad_() for value in (depth, albedo, light, camera)]
    cotangent = {
        name: torch.randn(shape, generator=torch.Generator().manual_seed(1))
        for name, shape in {"uv": (*depth.shape, 2), "depth": depth.shape, "image": albedo.shape}.items()
    }

    def forward(backend: str) -> tuple[Tensor, ...]:
        with torch.no_grad():
            seen = rasterize(vertices, focal, backend)
        return seen.uv, seen.depth, seen.mask

    def both_ways(backend: str) -> tuple[Tensor, ...]:
        seen = rasterize(vertices, focal, backend)
        return torch.autograd.grad((seen.uv, seen.depth), vertices, (cotangent["uv"], cotangent["depth"]))

    def whole_render(backend: str) -> tuple[Tensor, ...]:
        picture = render(*scene, FOV_DEG, backend)
        return torch.autograd.grad(
            (picture.image, picture.depth), scene, (cotangent["image"], cotangent["depth"])
        )

    def shade_then_warp_twice(backend: str) -> tuple[Tensor, ...]:
        canonical = shade(*scene[:3], FOV_DEG)
        pictures = [warp(canonical, depth, view, FOV_DEG, backend).image for view in (camera, -camera)]
        return torch.autograd.grad(pictures, scene, [cotangent["image"]] * 2)

    parts = {
        "rasterize forward": forward,
        "rasterize forward+backward": both_ways,
        "render forward+backward": whole_render,
        "shade once, warp twice f+b": shade_then_warp_twice,
    }
    rows = []
    print(
        f"{arguments.batch} images of {arguments.size}x{arguments.size}, {arguments.threads} thread(s); "
        f"first Numba call {compile_s:.2f} s"
    )
    print(f"{'ms per image':28} {'reference':>10} {'numba':>8} {'ratio':>7} {'difference':>11}")
    for name, part in parts.items():
        difference = check({backend: part(backend) for backend in BACKENDS})
        jobs = {backend: (lambda part=part, backend=backend: part(backend)) for backend in BACKENDS}
        ms = {backend: total / arguments.batch for backend, total in best_ms(jobs, arguments.repeats).items()}
        ratio = ms["reference"] / ms["numba"]
        rows.append({"part": name, "ms_per_image": ms, "ratio": ratio, "relative_difference": difference})
        print(f"{name:28} {ms['reference']:10.3f} {ms['numba']:8.3f} {ratio:6.1f}x {difference:11.1e}")
    settings = {key: value for key, value in vars(arguments).items() if key != "json"}
    publish({**settings, "first_call_s": compile_s, "rows": rows}, arguments.json)


if __name__ == "__main__":
    main()
