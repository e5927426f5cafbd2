"""First contact with a CUDA GPU: Triton beside the definition, then the training loop as users run it.

Renderings and gradients of the Triton kernels are compared with plain torch on the same device before any
clock runs, and the training step with the literal one (losses, gradients; without TensorFloat-32). Then
`train` itself runs on random images, with CUDA graphs and without; speed is that between two lines of its
metrics, so that start, graph recording and validation do not count. The literal step stands beside it.

    python benchmarks/gpu.py --vgg vgg16_relu3_3.npz --json benchmarks/results/gpu.json
"""

import json
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from literal.step import LiteralStep
from machine import parser, publish
from training_step import check_agreement, our_step

from derender.data import ImageSet
from derender.render import render
from derender.training import loop, train
from derender.training.config import resolve
from derender.training.loop import LOG_EVERY_STEPS

RUNS = (
    *(("paper", 64, 64, "32-true"), ("paper", 64, 64, "bf16-mixed"), ("paper", 64, 256, "bf16-mixed")),
    *(("paper", 64, 1024, "bf16-mixed"), ("small", 64, 16, "32-true"), ("small", 64, 256, "bf16-mixed")),
    *(("small", 128, 64, "32-true"), ("small", 256, 16, "32-true")),
)
"""Preset, pixels, batch, precision of the networks."""
STEPS = 2 * LOG_EVERY_STEPS + 2
SCENES, ROUNDS = 8, 20


def agreement(size: int, dtype: torch.dtype) -> dict[str, Any]:
    """Largest differences of Triton's renderings and gradients, by the largest magnitude of each."""
    noise = torch.Generator().manual_seed(size)
    coarse = torch.randn(SCENES, 1, 6, 6, generator=noise, dtype=dtype)
    depth = 1 + 0.03 * torch.nn.functional.interpolate(coarse, (size, size), mode="bicubic")[:, 0]
    albedo = torch.rand(SCENES, 3, size, size, generator=noise, dtype=dtype)
    light = torch.cat(
        [torch.rand(SCENES, 2, generator=noise), torch.rand(SCENES, 2, generator=noise) - 0.5], 1
    )
    camera = 0.6 * (torch.rand(SCENES, 6, generator=noise) - 0.5)
    camera[:, 3:] *= 0.1
    values = [value.to("cuda", dtype) for value in (depth, albedo, light, camera)]
    weight = torch.rand(SCENES, 3, size, size, generator=noise, dtype=dtype).to("cuda")
    kept = []
    for backend in ("reference", "triton"):
        inputs = [value.clone().requires_grad_() for value in values]
        result = render(inputs[0], inputs[1], inputs[2], inputs[3], backend=backend)
        gradients = torch.autograd.grad((result.image * weight).sum() + result.depth.sum(), inputs)
        kept.append([result.image, result.depth, result.mask, *gradients])
    names = (
        "image",
        "depth",
        "mask",
        *(f"gradient of {name}" for name in ("depth", "albedo", "light", "camera")),
    )
    pairs = zip(names, *kept, strict=True)
    worst = {name: float((b - a).abs().max() / a.abs().max().clamp(min=1e-30)) for name, a, b in pairs}
    return {"size": size, "dtype": str(dtype).removeprefix("torch."), **worst}


def trained(preset: str, size: int, batch: int, precision: str, graph: str, vgg: str) -> dict[str, Any]:
    """Images per second of a run's second half, and its highest memory on the device."""
    pixels = np.random.default_rng(0).integers(0, 256, (max(1280, 2 * batch), 3, size, size), dtype=np.uint8)
    files = tuple(f"{number:05d}.png" for number in range(len(pixels)))
    images, count = ImageSet(images=pixels, files=files, source="random"), STEPS * batch
    never = {f"{what}_every": 10 * count for what in ("validate", "sample", "checkpoint")}
    changes = [
        "self_features_steps=20",
        "pictures=0",
        "brightness=false",
        f"cuda_graph={graph}",
        "watch=true",
    ]
    changes += [
        f"image_size={size}",
        f"batch_size={batch}",
        f"precision={precision}",
        "split=[1.0, 0.0, 0.0]",
    ]
    if preset == "paper":
        changes.append(f"vgg16_path={vgg}")
    config = resolve(preset, changes, images=count, loocc="light+camera", **never)
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    with TemporaryDirectory() as folder:
        began = time.perf_counter()
        train(config, images, Path(folder) / "run")
        lines = [
            json.loads(line) for line in (Path(folder) / "run" / "metrics.jsonl").read_text().splitlines()
        ]
    start, end = [line for line in lines if line["kind"] == "train"][-2:]
    speed = (end["images"] - start["images"]) / (end["seconds"] - start["seconds"])
    return {
        "preset": preset, "size": size, "batch": batch, "precision": precision, "cuda_graph": graph,
        "images_per_second": round(speed, 1), "memory_gb": round(torch.cuda.max_memory_allocated() / 1e9, 2),
        "notes": [line["text"] for line in lines if line["kind"] == "note"],
        "whole_s": round(time.perf_counter() - began, 1),
    }  # fmt: skip


def literal_speed(batch: int) -> float:
    """Images per second of the official arithmetic done literally, launched step by step."""
    step, images = LiteralStep().to("cuda"), torch.rand(batch, 3, 64, 64, device="cuda")
    for _ in range(3):
        step.step(images)
    torch.cuda.synchronize()
    began = time.perf_counter()
    for _ in range(ROUNDS):
        step.step(images)
    torch.cuda.synchronize()
    return batch * ROUNDS / (time.perf_counter() - began)


def main() -> None:
    asks = parser(__doc__)
    asks.add_argument("--vgg", required=True, help="VGG16's weights up to relu3_3")
    asks.add_argument("--only", type=int, nargs="*", help="numbers of the runs, from 0 (default: all)")
    options = asks.parse_args()
    loop.FIRST_KEPT_IMAGES = 10**9  # no early checkpoint between the two lines
    result: dict[str, Any] = {"benchmark": "gpu", "device": torch.cuda.get_device_name(), "rows": []}
    cases = [(size, dtype) for size in (64, 128, 256) for dtype in (torch.float32, torch.float64)]
    result["agreement"] = [agreement(*case) for case in cases]
    print(*result["agreement"], sep="\n", flush=True)
    with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
        torch.manual_seed(0)
        noise = torch.Generator().manual_seed(0)
        literal = LiteralStep()
        ours = our_step(literal, "32-true")
        ours.model.to("cuda")
        ours.vgg.to("cuda")
        apart = check_agreement(
            literal.to("cuda"), ours, torch.rand(4, 3, 64, 64, generator=noise).to("cuda")
        )
    result["step_loss_difference"], result["step_gradient_difference"] = apart
    result["literal"] = {batch: round(literal_speed(batch), 1) for batch in (64, 256)}
    print(apart, result["literal"], flush=True)
    for number, run in enumerate(RUNS):
        ways = ("auto",) if run[2] == 1024 else ("auto", "off")  # at 1,024 the device is busy in either
        for graph in ways if options.only is None or number in options.only else ():
            result["rows"].append(trained(*run, graph, options.vgg))
            print(result["rows"][-1], flush=True)
            publish(result, options.json)


if __name__ == "__main__":
    main()
