"""Fitting scenes: steps along measured directions beside plain Adam of three times as many, on one thread.

All take turns in one run, on generated heads of other people than the model's. `plain` is Adam in the
coordinates themselves; in portions of four it is what derender first did. Scores are of the scenes that each
finds; the last column is `derender evaluate disentangle`, whose time goes into fitting.

    python benchmarks/fitting.py --rounds 3 --json fitting.json
"""

import statistics
import time
from contextlib import ExitStack
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from machine import parser, publish

import derender
from derender.data import ImageSet
from derender.data.synthetic import SyntheticSet, faces
from derender.evaluation import disentangle
from derender.evaluation.truth import geometry_scores
from derender.postprocess import embedding, fitting

MODEL, PLAIN_STEPS = "rendered-faces-64", 60
PLAIN = {"_STEP": 1.0, "_MOMENTUM": (0.9, 0.95), "_LATE": 0.6, "_BLOCK": 4}
WAYS = {
    "plain, portions of 4": (True, embedding.FEW),
    "plain": (True, embedding.MOST),
    "now": (False, embedding.MOST),
}


def model_for(stack: ExitStack, plain: bool, portion: int) -> tuple[derender.Derenderer, int]:
    """A fresh model that fits in this way while the stack is open, and its number of steps."""
    stack.enter_context(patch.object(embedding, "MOST", portion))
    if plain:
        for name, value in PLAIN.items():
            stack.enter_context(patch.object(fitting, name, value))
        axes = patch.object(
            fitting.Fitting, "_measured_directions", lambda self, render, rates, sizes: torch.eye(len(rates))
        )
        stack.enter_context(axes)
    steps, model = PLAIN_STEPS if plain else fitting.STEPS, derender.load(MODEL)
    return model.with_features(model.features.with_steps(steps)), steps


def scored(model: derender.Derenderer, fitted: fitting.Fitted, truth: SyntheticSet) -> dict[str, float]:
    """SIDE times 100, normals in degrees, and the error of the images of fitted scenes."""
    with torch.no_grad():
        rendering = model.render(fitted.scene)
    maps = (getattr(truth, name)[: len(fitted.after)] for name in ("depth", "mask", "normal"))
    depth, mask, normal = map(torch.from_numpy, maps)
    scores = geometry_scores(rendering.depth, rendering.mask > 0.5, depth, mask, truth.fov_deg, normal)
    return {"side": 100 * scores.side, "mad_deg": scores.mad_deg, "error": float(fitted.after.mean())}


def main() -> None:
    asks = parser(__doc__)
    asks.add_argument("--images", type=int, default=64, help="images that are fitted (default 64)")
    asks.add_argument("--scored", type=int, default=24, help="images of evaluate disentangle (default 24)")
    asks.add_argument("--rounds", type=int, default=3, help="rounds after one to warm up (default 3)")
    options = asks.parse_args()
    torch.set_num_threads(1)
    truth = faces.generate(max(options.images, options.scored), 64, seed=11)
    few = torch.from_numpy(np.ascontiguousarray(truth.images[: options.images])).float() / 255
    files = tuple(f"{number:03d}.png" for number in range(options.scored))
    images = ImageSet(images=truth.images[: options.scored], files=files)
    seconds: dict[str, list[float]] = {name: [] for name in WAYS}
    rows: dict[str, dict[str, Any]] = {}
    for number in range(options.rounds + 1):
        for name, way in WAYS.items():
            with ExitStack() as stack:
                model, steps = model_for(stack, *way)
                model.fit_scenes(few[:4], steps)  # measures its directions, once for a model
                began = time.process_time()
                fitted = model.fit_scenes(few, steps)
                if number:
                    seconds[name].append(time.process_time() - began)
                    continue
                rows[name] = {"steps": steps, **scored(model, fitted, truth)}
                began = time.process_time()
                scores = disentangle(model, images, seeds=(0,), cache="none").values["rows"]["model"][0]
                ratio = scores["swap"]["ratio"]
                rows[name] |= {"disentangle_s": time.process_time() - began, "swap_ratio": ratio}
    for name, taken in seconds.items():
        spread = (max(taken) - min(taken)) / len(few) * 1000
        rows[name] |= {"ms_per_image": 1000 * statistics.median(taken) / len(few), "spread_ms": spread}
    with ExitStack() as stack:
        model, _ = model_for(stack, plain=False, portion=embedding.MOST)
        began = time.process_time()
        for _ in range(10):
            model.decompose(few)
        feed_forward = 100 * (time.process_time() - began) / len(few)
    publish(
        {"benchmark": "fitting", "images": len(few), "rounds": options.rounds, "rows": rows,
         "feed_forward_ms_per_image": feed_forward, "disentangle_images": len(images)}, options.json,
    )  # fmt: skip


if __name__ == "__main__":
    main()
