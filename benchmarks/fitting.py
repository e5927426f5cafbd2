"""Fitting scenes in large portions beside portions of four, on one thread: processor time, and the same bits.

Both take turns in one run. Fitted coordinates have to be the same bit for bit. The second pair is
`derender evaluate disentangle`, whose time goes into fitting; its numbers have to be the same, too.

    python benchmarks/fitting.py --rounds 3 --json fitting.json
"""

import statistics
import time
from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from machine import parser, publish

import derender
from derender.data import ImageSet
from derender.data.synthetic import faces
from derender.evaluation import disentangle
from derender.postprocess import embedding

MODEL = "rendered-faces-64"


def in_turns(work: Callable[[], Any], rounds: int) -> tuple[dict[str, Any], list[Any]]:
    """Processor seconds of both, after a round to warm up, and what both gave last."""
    seconds: dict[int, list[float]] = {embedding.FEW: [], embedding.MOST: []}
    results: list[Any] = []
    for number in range(rounds + 1):
        results = []
        for most, result in seconds.items():
            with patch.object(embedding, "MOST", most):
                began = time.process_time()
                results.append(work())
                if number or not rounds:
                    result.append(time.process_time() - began)
    before, now = (statistics.median(result) for result in seconds.values())
    return {"portions_of_4_s": before, "now_s": now, "ratio": before / now, "rounds": rounds}, results


def main() -> None:
    asks = parser(__doc__)
    asks.add_argument("--images", type=int, default=64, help="images that are fitted (default 64)")
    asks.add_argument("--scored", type=int, default=24, help="images of evaluate disentangle (default 24)")
    asks.add_argument("--rounds", type=int, default=3, help="rounds after one to warm up (default 3)")
    options = asks.parse_args()
    torch.set_num_threads(1)
    model = derender.load(MODEL)
    pixels = faces.generate(max(options.images, options.scored), 64, seed=1).images
    few = torch.from_numpy(np.ascontiguousarray(pixels[: options.images])).float() / 255
    fitting, (old, new) = in_turns(lambda: model.fit_scenes(few, 60), options.rounds)
    same = all(torch.equal(old.coordinates[name], new.coordinates[name]) for name in old.coordinates)
    if not same:
        raise SystemExit("the fitted coordinates differ: nothing is reported")
    fitting["ms_per_image"] = 1000 * fitting["now_s"] / len(few)
    began = time.process_time()
    for _ in range(10):
        model.decompose(few)
    fitting["feed_forward_ms_per_image"] = 100 * (time.process_time() - began) / len(few)
    files = tuple(f"{number:03d}.png" for number in range(options.scored))
    images = ImageSet(images=pixels[: options.scored], files=files)
    scoring, (old, new) = in_turns(lambda: disentangle(model, images, seeds=(0,)).values["rows"], 1)
    apart = abs(old["model"][0]["swap"]["ratio"] - new["model"][0]["swap"]["ratio"])
    print(fitting, scoring, f"swap ratios differ by {apart:.1e}", sep="\n")
    publish(
        {"benchmark": "fitting", "images": len(few), "steps": 60, "fit": fitting, "disentangle": scoring,
         "disentangle_images": len(images), "swap_ratio_difference": apart}, options.json,
    )  # fmt: skip


if __name__ == "__main__":
    main()
