"""Everything there is to check and to time on one CUDA device, in one command, as one JSON file.

Checks first: the Triton renderer against its plain torch definition at every size from 32 to 512, outputs
and gradients, and whether runs repeat. Then times: renderer, training step (float32, bfloat16, with LOOCC;
plain, as a CUDA graph, compiled) beside the official step's arithmetic done literally in the same run,
embedding, and the memory a picture takes in training at 64, 128 and 256 pixels. A part that fails is reported
as a failure and the rest goes on; the file is written after each part. Weights and pictures are random:
neither changes the work.

    python benchmarks/gpu.py --json gpu.json
    TRITON_INTERPRET=1 python benchmarks/gpu.py --dry-run --json dry.json

``--dry-run`` goes through the same parts on the CPU, the kernels in Triton's interpreter, with sizes so small
that its times mean nothing. Beside torch, Triton and numpy this needs what the model needs: jaxtyping,
pydantic, PyYAML and safetensors.
"""

import argparse
import json
import math
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from machine import ROOT, commit, processor
from torch import Tensor

for folder in (ROOT / "src", ROOT):
    sys.path.insert(0, str(folder))

from literal.step import LiteralStep  # noqa: E402

from derender.model import Derenderer  # noqa: E402
from derender.objectives import Vgg16Features  # noqa: E402
from derender.render import render  # noqa: E402
from derender.render.rasterize import rasterize  # noqa: E402
from derender.scene.camera import focal_px, to_camera, unproject  # noqa: E402
from derender.training.config import resolve  # noqa: E402
from derender.training.step import training_step  # noqa: E402

FOV_DEG = 10.0
AGREEMENT = 1e-5  # of the largest value, float32
TRAINING_GFLOP_FLOOR_US = 27.0  # an image's share of the step at a H200's measured bfloat16 speed


@dataclass(frozen=True)
class Sizes:
    """What is run: at full size, or in the dry run."""

    device: str = "cuda"
    checked: tuple[tuple[int, int], ...] = ((32, 8), (64, 8), (128, 4), (256, 2), (512, 1))  # pixels, maps
    rasterised: tuple[tuple[int, int], ...] = ((64, 16), (64, 192), (256, 16))
    batches: tuple[int, ...] = (64, 128, 256)
    embedded: int = 1024
    measured: tuple[tuple[int, int], ...] = ((64, 64), (128, 32), (256, 16))  # pixels, pictures
    modes: tuple[str, ...] = ("plain", "graph", "compiled")
    width: int = 64
    steps: int = 20
    rounds: int = 3


DRY = Sizes(
    device="cpu", checked=((5, 2),), rasterised=((4, 1),), batches=(2,), embedded=2, measured=((32, 2),),
    modes=("plain",), width=4, steps=1, rounds=1,
)  # fmt: skip


def wait(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


def milliseconds(job: Callable[[], object], sizes: Sizes) -> float:
    """Median over rounds of the mean time of a job, after two runs to warm up (one in the dry run)."""
    for _ in range(min(2, sizes.steps)):
        job()
    rounds = []
    for _ in range(sizes.rounds):
        wait(sizes.device)
        began = time.perf_counter()
        for _ in range(sizes.steps):
            job()
        wait(sizes.device)
        rounds.append(1e3 * (time.perf_counter() - began) / sizes.steps)
    return statistics.median(rounds)


def surfaces(count: int, size: int, device: str) -> list[Tensor]:
    """Rolling depth, random colours, light and cameras, each with gradient."""
    draw = torch.Generator().manual_seed(0)
    depth = 1 + 0.02 * torch.nn.functional.avg_pool2d(
        torch.randn(count, 1, size + 4, size + 4, generator=draw), 5, 1
    )[:, 0]  # fmt: skip
    albedo = torch.rand(count, 3, size, size, generator=draw)
    light = torch.rand(count, 4, generator=draw) * torch.tensor([0.5, 0.5, 1.0, 1.0]) + 0.2
    camera = torch.randn(count, 6, generator=draw) * torch.tensor([0.14, 0.31, 0.07, 0.0035, 0.0035, 0.0])
    return [value.to(device).requires_grad_() for value in (depth, albedo, light, camera)]


def render_both_ways(values: list[Tensor], backend: str) -> dict[str, Tensor]:
    """Picture, depth, mask and the gradient of each input for random cotangents."""
    result = render(*values, FOV_DEG, backend)
    draw = torch.Generator().manual_seed(1)
    outputs = (result.image, result.depth)
    weights = [torch.randn(value.shape, generator=draw).to(value) for value in outputs]
    gradients = torch.autograd.grad(outputs, values, weights)
    names = ("image", "depth", "mask", "d/d depth", "d/d albedo", "d/d light", "d/d camera")
    values = [value.detach() for value in (*outputs, result.mask, *gradients)]
    return dict(zip(names, values, strict=True))


def check_renderer(sizes: Sizes) -> dict[str, Any]:
    """Largest difference from the definition, relative to the largest value; and whether runs repeat."""
    rows = []
    for size, count in sizes.checked:
        for kind in ("smooth", "grazing", "rough"):
            values = surfaces(count, size, sizes.device)
            with torch.no_grad():
                if kind == "grazing":
                    values[3][:, 1] = math.radians(85)
                if kind == "rough" and size <= 64:  # long triangles: the definition needs minutes beyond
                    values[0].uniform_(0.9, 1.1)
            expected, found = (render_both_ways(values, backend) for backend in ("reference", "triton"))
            worst = {
                name: float((found[name] - value).abs().max() / value.abs().max().clamp(min=1e-6))
                for name, value in expected.items()
            }
            again = render_both_ways(values, "triton")
            forward_repeats = all(
                torch.equal(found[name], again[name]) for name in ("image", "depth", "mask")
            )
            was = torch.are_deterministic_algorithms_enabled()
            torch.use_deterministic_algorithms(True)
            one, other = (render_both_ways(values, "triton") for _ in range(2))
            torch.use_deterministic_algorithms(was)
            repeats = all(torch.equal(one[name], other[name]) for name in one)
            near = max(
                float((one[n] - v).abs().max() / v.abs().max().clamp(min=1e-6)) for n, v in expected.items()
            )
            rows.append(
                {
                    "pixels": size, "maps": count, "surface": kind, "difference": worst,
                    "forward_repeats": forward_repeats, "deterministic_repeats": repeats,
                    "deterministic_difference": near,
                    "passed": max(*worst.values(), near) <= AGREEMENT and forward_repeats and repeats,
                }
            )  # fmt: skip
    return {"allowed": AGREEMENT, "rows": rows, "passed": all(row["passed"] for row in rows)}


def time_renderer(sizes: Sizes) -> dict[str, Any]:
    rows = []
    for size, count in sizes.rasterised:
        values = surfaces(count, size, sizes.device)
        focal = focal_px(size, FOV_DEG)
        points = to_camera(unproject(values[0], FOV_DEG), values[3]).detach().requires_grad_()
        row: dict[str, Any] = {"pixels": size, "maps": count}
        for backend in ("triton", "reference") if count <= 16 else ("triton",):

            def rasterise(points=points, focal=focal, backend=backend) -> None:
                seen = rasterize(points, focal, backend)
                torch.autograd.grad(seen.uv.sum() + seen.depth.sum(), points)

            def draw(values=values, backend=backend) -> None:
                torch.autograd.grad(render(*values, FOV_DEG, backend).image.sum(), values)

            row[f"rasterise both ways, {backend}, ms"] = milliseconds(rasterise, sizes)
            row[f"render both ways, {backend}, ms"] = milliseconds(draw, sizes)
        rows.append(row)
    return {"rows": rows}


class OurStep:
    """derender's training step at one precision, with or without LOOCC, run in one of three modes."""

    def __init__(self, sizes: Sizes, batch: int, precision: str, loocc: str, mode: str, pixels: int = 64):
        objective = resolve("paper", [f"loocc={loocc}"]).objective
        self.model = Derenderer.from_preset("paper", seed=0, image_size=pixels, width=sizes.width)
        self.model.to(device=sizes.device, memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        vgg = Vgg16Features().to(device=sizes.device, memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        generator = torch.Generator(sizes.device).manual_seed(0)
        self.images = torch.rand(batch, 3, pixels, pixels, device=sizes.device)
        cuda = sizes.device == "cuda"
        self.optimiser = torch.optim.Adam(
            self.model.parameters(),
            lr=1e-4,
            weight_decay=5e-4,
            fused=True,
            capturable=cuda and mode == "graph",
        )
        networks = (
            partial(torch.autocast, sizes.device, torch.bfloat16) if precision == "bf16" else nullcontext
        )

        def loss() -> Tensor:
            return training_step(self.model, self.images, objective, vgg, generator, networks).total

        self.loss = torch.compile(loss) if mode == "compiled" else loss
        self.step = self.plain
        if mode == "graph":
            self.step = self.captured(generator)

    def plain(self) -> None:
        self.optimiser.zero_grad(set_to_none=True)
        self.loss().backward()
        self.optimiser.step()

    def captured(self, generator: torch.Generator) -> Callable[[], None]:
        """The whole step as one CUDA graph."""
        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            for _ in range(3):
                self.plain()
        torch.cuda.current_stream().wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        graph.register_generator_state(generator)
        self.optimiser.zero_grad(set_to_none=True)
        with torch.cuda.graph(graph):
            self.loss().backward()
            self.optimiser.step()
        return graph.replay


def literal_step(sizes: Sizes, batch: int) -> Callable[[], float]:
    step, images = LiteralStep().to(sizes.device), torch.rand(batch, 3, 64, 64, device=sizes.device)
    return partial(step.step, images)


def time_training(sizes: Sizes) -> dict[str, Any]:
    """Images per second; ``against literal`` compares with the literal step of the same batch."""
    rows: list[dict[str, Any]] = []
    for batch in sizes.batches:
        literal = 1e3 * batch / milliseconds(literal_step(sizes, batch), sizes)
        rows.append({"step": "literal, float32", "batch": batch, "images_per_second": literal})
        for precision, loocc in (("float32", "none"), ("bf16", "none"), ("bf16", "light+camera")):
            for mode in sizes.modes:
                row: dict[str, Any] = {
                    "step": f"derender, {precision}, loocc {loocc}, {mode}",
                    "batch": batch,
                }
                began = time.perf_counter()
                try:
                    ours = OurStep(sizes, batch, precision, loocc, mode)
                    ours.step()
                    wait(sizes.device)
                    row["first_step_s"] = time.perf_counter() - began
                    speed = 1e3 * batch / milliseconds(ours.step, sizes)
                except Exception as error:
                    row["failed"] = f"{type(error).__name__}: {str(error).splitlines()[0][:300]}"
                else:
                    row["images_per_second"] = speed
                    row["against_literal"] = speed / literal
                    row["share_of_floor"] = speed * TRAINING_GFLOP_FLOOR_US / 1e6
                rows.append(row)
                forget()
    return {"rows": rows}


def time_embedding(sizes: Sizes) -> dict[str, Any]:
    model = Derenderer.from_preset("paper", seed=0, width=sizes.width).to(
        device=sizes.device, memory_format=torch.channels_last
    )  # pyright: ignore[reportCallIssue]
    images = torch.rand(sizes.embedded, 3, 64, 64, device=sizes.device)

    def embed() -> None:
        with torch.inference_mode(), torch.autocast(sizes.device, torch.bfloat16):
            model.embed(images)

    return {"batch": sizes.embedded, "images_per_second": 1e3 * sizes.embedded / milliseconds(embed, sizes)}


def measure_memory(sizes: Sizes) -> dict[str, Any]:
    """Peak memory of a bfloat16 LOOCC step per picture, above what the networks and their gradients take."""
    rows = []
    for pixels, count in sizes.measured:
        peaks = []
        for batch in (count // 2, count):
            step = OurStep(sizes, max(batch, 2), "bf16", "light+camera", "plain", pixels)
            step.step()
            if sizes.device == "cuda":
                torch.cuda.reset_peak_memory_stats()
            step.step()
            peaks.append(torch.cuda.max_memory_allocated() if sizes.device == "cuda" else 0)
            del step
            forget()
        added = (peaks[1] - peaks[0]) / max(count - count // 2, 1)
        rows.append({"pixels": pixels, "batch": count, "peak_bytes": peaks[1], "bytes_per_picture": added})
    return {"rows": rows}


def forget() -> None:
    if torch.cuda.is_available():
        torch.cuda.empty_cache()


def machine(device: str) -> dict[str, Any]:
    return {
        "device": torch.cuda.get_device_name() if device == "cuda" else "cpu",
        "processor": processor(), "python": platform.python_version(), "torch": torch.__version__,
        "cuda": torch.version.cuda, "triton": import_module("triton").__version__, "commit": commit(),
    }  # fmt: skip


PARTS = {
    "check": check_renderer, "renderer": time_renderer, "training": time_training,
    "embedding": time_embedding, "memory": measure_memory,
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--json", type=Path, default=Path("gpu.json"), help="where results go (default gpu.json)"
    )
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), help="only these")
    parser.add_argument("--dry-run", action="store_true", help="tiny sizes on the CPU, in the interpreter")
    options = parser.parse_args()
    if options.dry_run and os.environ.get("TRITON_INTERPRET") != "1":
        raise SystemExit("--dry-run runs kernels in Triton's interpreter: set TRITON_INTERPRET=1 before it")
    if not options.dry_run and not torch.cuda.is_available():
        raise SystemExit("there is no CUDA device here; --dry-run tries the script without one")
    sizes = DRY if options.dry_run else Sizes()
    results: dict[str, Any] = {"dry_run": options.dry_run, "machine": machine(sizes.device)}
    for name in options.parts:
        began = time.perf_counter()
        try:
            part = PARTS[name](sizes)
        except Exception as error:
            part = {"failed": f"{type(error).__name__}: {error}"}
        results[name] = {**part, "took_s": round(time.perf_counter() - began, 1)}
        print(json.dumps({name: results[name]}, indent=1), flush=True)
        options.json.write_text(json.dumps(results, indent=1) + "\n")
    failed = [
        name for name in options.parts if "failed" in results[name] or results[name].get("passed") is False
    ]
    raise SystemExit(f"failed: {', '.join(failed)}" if failed else 0)


if __name__ == "__main__":
    main()
