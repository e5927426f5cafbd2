"""Sheets of maps over images: the input, then a column for each factor with its share of the answer.

The arrangement is that of the paper's figure (Klinghoffer et al., ECCV 2022): input, geometry, albedo, light,
camera. Each map is scaled by its own largest value: brightness shows where, the percentage how much.
"""

import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from matplotlib import colormaps
from PIL import Image
from torch import Tensor

from derender.baselines.controls import untrained_twin
from derender.features.extract import as_batch
from derender.interpretation import Explained, Probe
from derender.interpretation import attribution as attributed
from derender.report.colours import Images, pictures
from derender.report.panel import GridLayout, contact_sheet, labelled_grid

STRENGTH = 0.75
SHOWN_PX = 64
BLURRED_PX = 5  # of 64: single pixels say little
LAYOUT = GridLayout(cell=128, gap=6, label=13, title=18)
Pixels = Float[Tensor, "n 3 h w"]


def overlays(images: Pixels, maps: Float[Tensor, "n y x"]) -> Images:
    """Maps of any size over grey images in 0..1; an empty map leaves the image grey.

    Maps of the images' size are smoothed over squares of about a twelfth of their side.
    """
    size = images.shape[-1]
    if maps.shape[-1] == size:
        side = max(1, round(BLURRED_PX * size / SHOWN_PX)) // 2 * 2 + 1
        how = {"stride": 1, "padding": side // 2, "count_include_pad": False}
        heat = attributed.to_one(torch.nn.functional.avg_pool2d(maps[:, None], side, **how)[:, 0])
    else:
        heat = attributed.to_one(attributed.upsampled(maps, size))
    heat, grey = heat.cpu().numpy()[..., None], images.mean(dim=1).cpu().numpy()[..., None]
    blended = grey * (1 - STRENGTH * heat) + colormaps["inferno"](heat[..., 0])[..., :3] * STRENGTH * heat
    return pictures(np.moveaxis(blended, -1, 1))


def saliency_sheet(
    model: Any, probe: Probe, images: Pixels, target: int, method: str, title: str
) -> Image.Image:
    """One row for each image: the input and its answer, then each factor's map and share of |IG|."""
    with torch.no_grad():
        features = {name: code.float().cpu().numpy() for name, code in model.embed(images).items()}
    attribution, _ = attributed.integrated_gradients(probe, probe.columns(features), target)
    shares, answers = attributed.factor_shares(attribution, probe), probe.probabilities(features)[:, target]
    targets = [target] * len(images)
    maps = (attributed.saliency(method, model, images, name, probe, targets) for name in probe.factors)
    columns = [pictures(images), *(overlays(images, drawn) for drawn in maps)]
    captions = []
    for answer, row in zip(answers, shares, strict=True):
        captions.append(f"input, p = {answer:.2f}")
        captions += [f"{name} {100 * share:.0f} %" for name, share in zip(probe.factors, row, strict=True)]
    cells = [cell for row in zip(*columns, strict=True) for cell in row]
    return contact_sheet(cells, captions, across=len(columns), title=title, layout=LAYOUT)


def draw_maps(
    explained: Explained,
    *,
    labels: int = 3,
    rows: int = 6,
    progress: Callable[[int, int], object] | None = None,
) -> tuple[dict[str, dict[str, Image.Image]], list[attributed.Similarity]]:
    """Sheets for so many labels with the highest AUC, and the sanity check of the maps on the first of them.

    A sheet has ``rows`` held-out images with the label; ``progress`` is called with (labels done, in all).
    """
    model, shares, targets = explained.model, explained.shares, explained.task.targets
    probe, test, seeds = shares.probe, explained.split.test, range(len(shares.rows[0].shares))
    auc = np.nan_to_num(shares.rows[0].auc.mean(axis=0), nan=-1)
    best = [int(at) for at in np.argsort(-auc, kind="stable") if (targets[test, at] == 1).sum() >= 2][:labels]
    sheets: dict[str, dict[str, Image.Image]] = {}
    checks: list[attributed.Similarity] = []
    for place, target in enumerate(best):
        carriers = test[targets[test, target] == 1]
        chosen = np.random.default_rng(0).permutation(carriers)[:rows]
        batch = as_batch(explained.images.images[np.sort(chosen)], model.device)
        name = shares.names[target]
        made = sheets[name] = {
            method: saliency_sheet(model, probe, batch, target, method, f"{name}: {method}")
            for method in attributed.METHODS
        }
        if not checks:
            asked = np.full(len(batch), target)
            checks = attributed.sanity_check(model, probe, shares.shuffled, batch, asked, seeds=seeds)
            fresh, title = untrained_twin(model, 0), f"{name}: grad-cam with fresh weights"
            made["fresh weights"] = saliency_sheet(fresh, probe, batch, target, "grad-cam", title)
            made["feature"] = feature_sheet(model, batch, shares.factors)
        if progress is not None:
            progress(place + 1, len(best))
    return sheets, checks


def feature_sheet(model: Any, images: Pixels, factors: Sequence[str]) -> Image.Image:
    """Where each factor's feature comes from, without a question."""
    columns = {"input": pictures(images)}
    columns |= {
        name: overlays(images, attributed.saliency("grad-cam", model, images, name)) for name in factors
    }
    return labelled_grid(columns, title="the feature itself", layout=LAYOUT)


def safe_name(name: str) -> str:
    """A label as part of a file's name."""
    return re.sub(r"[^\w-]+", "-", name).strip("-")[:40] or "label"
