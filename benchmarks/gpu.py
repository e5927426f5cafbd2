"""Everything there is to check and to time on one CUDA device, in one command, as one JSON file.

Checks first: the Triton renderer against its plain torch definition at every size from 32 to 512, outputs
and gradients, and whether runs repeat; the training step's loss against that of the official step, done
literally. Then times: renderer, training step (float32, bfloat16, with LOOCC; plain, as a CUDA graph,
compiled) beside the literal one in the same run, thirty epochs of the training command's own loop on as many
images as UTKFace has (or on ``--data``), embedding, and the memory an image takes in training at 64, 128
and 256 pixels, whole and in chunks. In the end the numbers stand beside what is aimed at. A part that fails
is reported as a failure and the rest goes on; the file is written after each part. Weights and images are
random: neither changes the work.

    python benchmarks/gpu.py --json benchmarks/results/gpu.json
    TRITON_INTERPRET=1 python benchmarks/gpu.py --dry-run --json dry.json

``--dry-run`` goes through the same parts on the CPU, the kernels in Triton's interpreter, with sizes so small
that its times mean nothing. Beside torch, Triton and numpy this needs what the model needs: jaxtyping,
pydantic, PyYAML and safetensors; the part ``epochs`` needs lightning-fabric and tensorboard, too.
"""

import argparse
import json
import math
import os
import platform
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # else torch refuses to repeat itself

import numpy as np
import torch
from machine import ROOT, commit, processor
from torch import Tensor

for folder in (ROOT / "src", ROOT):
    sys.path.insert(0, str(folder))

from gpu_steps import OurStep, agreement, literal_step  # noqa: E402

from derender.model import Derenderer  # noqa: E402
from derender.render import render  # noqa: E402
from derender.render.rasterize import rasterize  # noqa: E402
from derender.scene.camera import focal_px, to_camera, unproject  # noqa: E402
from derender.training.process import deterministic_algorithms  # noqa: E402

FOV_DEG = 10.0
AGREEMENT = 1e-5  # of the largest value, float32
LOSS_AGREEMENT = 1e-5
TRAINING_GFLOP_FLOOR_US = 27.0  # an image's share of the step at a H200's measured bfloat16 speed
UTKFACE_PICTURES = 23_705
TARGET = "bf16, loocc light+camera"


@dataclass(frozen=True)
class Sizes:
    """What is run: at full size, or in the dry run."""

    device: str = "cuda"
    checked: tuple[tuple[int, int], ...] = ((32, 8), (64, 8), (128, 4), (256, 2), (512, 1))  # pixels, maps
    rasterised: tuple[tuple[int, int], ...] = ((64, 16), (64, 192), (256, 16))
    batches: tuple[int, ...] = (64, 128, 256)
    compiled: tuple[int, ...] = (128,)  # compiling takes minutes: one batch size, one objective
    embedded: int = 1024
    pictures: int = UTKFACE_PICTURES
    epochs: tuple[str, ...] = ("batch_size=256", "precision=bf16-mixed")
    measured: tuple[tuple[int, int], ...] = ((64, 64), (128, 32), (256, 16))  # pixels, images
    modes: tuple[str, ...] = ("plain", "graph", "compiled")
    chunks: tuple[int, ...] = (1, 8)
    data: str | None = None
    width: int = 64
    steps: int = 20
    rounds: int = 3


DRY = Sizes(
    device="cpu", checked=((5, 2),), rasterised=((4, 1),), batches=(2,), embedded=2, measured=((32, 2),),
    modes=("plain",), compiled=(), width=4, steps=1, rounds=1, pictures=40,
    epochs=("batch_size=8", "image_size=32", "width=8", "light_width=4", "self_features_steps=2"),
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
    """Image, depth, mask and the gradient of each input for random cotangents."""
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
            with deterministic_algorithms(True):
                one, other = (render_both_ways(values, "triton") for _ in range(2))
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


def check_loss(sizes: Sizes) -> dict[str, Any]:
    """derender's float32 step against the literal one; gradients differ where rounding crosses an edge."""
    apart = agreement(sizes.device, sizes.batches[0])
    return {"allowed": LOSS_AGREEMENT, "difference": apart, "passed": apart["loss"] <= LOSS_AGREEMENT}


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


def time_training(sizes: Sizes) -> dict[str, Any]:
    """Images per second; ``against literal`` compares with the literal step of the same batch."""
    rows: list[dict[str, Any]] = []
    for batch in sizes.batches:
        literal = 1e3 * batch / milliseconds(literal_step(sizes.device, batch), sizes)
        rows.append({"step": "literal, float32", "batch": batch, "images_per_second": literal})
        for precision, loocc in (("float32", "none"), ("bf16", "none"), ("bf16", "light+camera")):
            for mode in sizes.modes:
                if mode == "compiled" and (batch not in sizes.compiled or loocc == "none"):
                    continue
                row: dict[str, Any] = {
                    "step": f"derender, {precision}, loocc {loocc}, {mode}",
                    "batch": batch,
                }
                began = time.perf_counter()
                try:
                    ours = OurStep(sizes.device, sizes.width, batch, precision, loocc, mode)
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


def time_epochs(sizes: Sizes) -> dict[str, Any]:
    """Thirty epochs of the real loop: reading ahead, watcher, validation, checkpoints and all."""
    from derender.data import ImageSet, read_images, split_indices
    from derender.training import resolve, train

    size = next((int(one[11:]) for one in sizes.epochs if one.startswith("image_size=")), 64)
    if sizes.data is not None:
        pictures = read_images(sizes.data, size)
    else:
        noise = np.random.default_rng(0).integers(0, 256, (sizes.pictures, 3, size, size), dtype=np.uint8)
        pictures = ImageSet(noise, tuple(f"{row:06d}.png" for row in range(len(noise))), source="noise")
    settings = ["loocc=light+camera", "perceptual=self", "whitening.pictures=0", *sizes.epochs]
    settings += ["watch=false"] if sizes.data is None else []
    config = resolve("paper", settings)
    shown = 30 * len(split_indices(pictures.files, config.split, seed=config.seed).train)
    shown = shown if sizes.device == "cuda" else 2 * config.batch_size
    config = config.model_copy(update={"images": shown, "validate_every": max(1, shown // 5), "patience": 99})
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        result = train(config, pictures, Path(folder) / "run", accelerator=sizes.device)
        wall = time.perf_counter() - began
    return {
        "pictures": len(pictures), "shown": result.images, "stopped": result.stopped,
        "seconds": result.seconds, "wall_seconds": wall, "images_per_second": result.images_per_second,
        "waiting": result.waiting,
    }  # fmt: skip


def time_embedding(sizes: Sizes) -> dict[str, Any]:
    model = Derenderer.from_preset("paper", seed=0, width=sizes.width).to(
        device=sizes.device, memory_format=torch.channels_last
    )  # pyright: ignore[reportCallIssue]
    model.eval()
    images = torch.rand(sizes.embedded, 3, 64, 64, device=sizes.device)
    images = images.contiguous(memory_format=torch.channels_last)

    def embed() -> None:
        with torch.inference_mode(), torch.autocast(sizes.device, torch.bfloat16):
            model.embed(images)

    batch = sizes.batches[-1]
    step = OurStep(sizes.device, sizes.width, batch, "bf16", "light+camera", "plain")
    trained = 1e3 * batch / milliseconds(step.step, sizes)
    embedded = 1e3 * sizes.embedded / milliseconds(embed, sizes)
    return {
        "batch": sizes.embedded, "images_per_second": embedded, "training_images_per_second": trained,
        "against_training": embedded / trained,
    }  # fmt: skip


def measure_memory(sizes: Sizes) -> dict[str, Any]:
    """Peak memory of a bfloat16 LOOCC step per image, above what the networks and their gradients take."""
    rows = []
    for pixels, count, chunks in [(*one, chunks) for one in sizes.measured for chunks in sizes.chunks]:
        peaks = []
        for batch in (count // 2, count):
            step = OurStep(
                sizes.device, sizes.width, max(batch, 2), "bf16", "light+camera", "plain", pixels, chunks
            )
            step.step()
            if sizes.device == "cuda":
                torch.cuda.reset_peak_memory_stats()
            step.step()
            peaks.append(torch.cuda.max_memory_allocated() if sizes.device == "cuda" else 0)
            del step
            forget()
        added = (peaks[1] - peaks[0]) / max(count - count // 2, 1)
        row = {"pixels": pixels, "batch": count, "chunks": chunks, "peak_bytes": peaks[1]}
        rows.append({**row, "bytes_per_picture": added})
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


def aims(results: dict[str, Any]) -> list[dict[str, Any]]:
    """What the numbers are held against; ``got`` is None where that part was not run or failed."""
    rows = [row for row in results.get("training", {}).get("rows", []) if TARGET in row["step"]]
    best = max(rows, key=lambda row: row.get("images_per_second", 0.0), default={})
    epochs, embedding = results.get("epochs", {}), results.get("embedding", {})
    wanted = (
        ("training step with LOOCC, images/s", best.get("images_per_second"), 14_000, True),
        ("the same, share of the floor", best.get("share_of_floor"), 0.4, True),
        ("the same, against literal", best.get("against_literal"), 10, True),
        ("30 epochs of UTKFace, s", epochs.get("wall_seconds"), 120, False),
        ("embedding against training", embedding.get("against_training"), 20, True),
    )
    return [
        {"what": what, "got": got, "aim": aim, "reached": got is not None and (got >= aim) == more}
        for what, got, aim, more in wanted
    ]


PARTS = {
    "check": check_renderer, "loss": check_loss, "renderer": time_renderer, "training": time_training,
    "epochs": time_epochs, "embedding": time_embedding, "memory": measure_memory,
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--json", type=Path, default=Path("gpu.json"), help="where results go (default gpu.json)"
    )
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), help="only these")
    parser.add_argument("--data", help="images of the part epochs (default: noise, as many as UTKFace has)")
    parser.add_argument("--dry-run", action="store_true", help="tiny sizes on the CPU, in the interpreter")
    options = parser.parse_args()
    if options.dry_run and os.environ.get("TRITON_INTERPRET") != "1":
        raise SystemExit("--dry-run runs kernels in Triton's interpreter: set TRITON_INTERPRET=1 before it")
    if not options.dry_run and not torch.cuda.is_available():
        raise SystemExit("there is no CUDA device here; --dry-run tries the script without one")
    sizes = DRY if options.dry_run else Sizes(data=options.data)
    options.json.parent.mkdir(parents=True, exist_ok=True)
    results: dict[str, Any] = {"dry_run": options.dry_run, "machine": machine(sizes.device)}
    for name in options.parts:
        began = time.perf_counter()
        try:
            part = PARTS[name](sizes)
        except Exception as error:
            part = {"failed": f"{type(error).__name__}: {error}"}
        results[name] = {**part, "took_s": round(time.perf_counter() - began, 1)}
        print(json.dumps({name: results[name]}, indent=1), flush=True)
        results["aims"] = aims(results)
        options.json.write_text(json.dumps(results, indent=1) + "\n")
    for row in results["aims"] if not options.dry_run else ():
        print(
            f"{row['what']}: {row['got']}, aim {row['aim']}: {'reached' if row['reached'] else 'not reached'}"
        )
    failed = [
        name for name in options.parts if "failed" in results[name] or results[name].get("passed") is False
    ]
    raise SystemExit(f"failed: {', '.join(failed)}" if failed else 0)


if __name__ == "__main__":
    main()
