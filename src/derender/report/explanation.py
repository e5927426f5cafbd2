"""The page of an explanation: shares beside controls, maps over images, and whether to trust the maps.

Sheets of maps are arranged as the paper's figure (Klinghoffer et al., ECCV 2022): input, geometry, albedo,
light, camera, each with its share of the answer. Each map is scaled by its own largest value: brightness
shows where, the percentage how much.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from PIL import Image
from torch import Tensor

from derender.baselines.controls import untrained_twin
from derender.features.extract import as_batch, factor_codes
from derender.interpretation import attribution, tables
from derender.interpretation.explanation import Explained
from derender.interpretation.probe import Probe
from derender.report.charts import INK, SERIES, Chart, side_by_side
from derender.report.colours import Images, pictures
from derender.report.page import Page
from derender.report.panel import GridLayout, contact_sheet, labelled_grid
from derender.storage.atomic import atomic_folder, require_replaceable

STRENGTH = 0.75
LAYOUT = GridLayout(cell=128, gap=6, label=13, title=18)
Pixels = Float[Tensor, "n 3 h w"]


def overlays(images: Pixels, maps: Float[Tensor, "n y x"]) -> Images:
    """Maps of any size over grey images in 0..1; an empty map leaves the image grey.

    Maps of the images' size are smoothed over squares of about a twelfth of their side.
    """
    size = images.shape[-1]
    if maps.shape[-1] == size:
        side = max(1, round(size / 12.8)) // 2 * 2 + 1  # single pixels say little
        how = {"stride": 1, "padding": side // 2, "count_include_pad": False}
        heat = attribution.to_one(torch.nn.functional.avg_pool2d(maps[:, None], side, **how)[:, 0])
    else:
        heat = attribution.to_one(attribution.upsampled(maps, size))
    heat, grey = heat.cpu().numpy()[..., None], images.mean(dim=1).cpu().numpy()[..., None]
    blended = grey * (1 - STRENGTH * heat) + colormaps["inferno"](heat[..., 0])[..., :3] * STRENGTH * heat
    return pictures(np.moveaxis(blended, -1, 1))


def saliency_sheet(
    model: Any, probe: Probe, images: Pixels, target: int, method: str, title: str
) -> Image.Image:
    """One row for each image: the input and its answer, then each factor's map and share of |IG|."""
    with torch.no_grad():
        features = factor_codes(model, images)
    gradients, _ = attribution.integrated_gradients(probe, probe.columns(features), target)
    shares, answers = attribution.factor_shares(gradients, probe), probe.probabilities(features)[:, target]
    targets = [target] * len(images)
    maps = (attribution.saliency(method, model, images, name, probe, targets) for name in probe.factors)
    columns = [pictures(images), *(overlays(images, drawn) for drawn in maps)]
    captions = []
    for answer, row in zip(answers, shares, strict=True):
        captions.append(f"input, p = {answer:.2f}")
        captions += [f"{name} {100 * share:.0f} %" for name, share in zip(probe.factors, row, strict=True)]
    cells = [cell for row in zip(*columns, strict=True) for cell in row]
    return contact_sheet(cells, captions, across=len(columns), title=title, layout=LAYOUT)


def draw_maps(
    explained: Explained, labels: int, rows: int, progress: Callable[[int, int], object]
) -> tuple[dict[str, dict[str, Image.Image]], list[attribution.Similarity]]:
    """Sheets for so many labels with the highest AUC, and the sanity check of the maps on the first of them.

    A sheet has ``rows`` held-out images with the label; ``progress`` is called with (labels done, in all).
    """
    model, shares, targets = explained.model, explained.shares, explained.task.targets
    probe, test, seeds = shares.probe, explained.split.test, range(len(shares.rows[0].shares))
    auc = np.nan_to_num(shares.rows[0].auc.mean(axis=0), nan=-1)
    best = [int(at) for at in np.argsort(-auc, kind="stable") if (targets[test, at] == 1).sum() >= 2][:labels]
    sheets: dict[str, dict[str, Image.Image]] = {}
    checks: list[attribution.Similarity] = []
    for place, target in enumerate(best):
        carriers = test[targets[test, target] == 1]
        chosen = np.random.default_rng(0).permutation(carriers)[:rows]
        batch = as_batch(explained.images.images[np.sort(chosen)], model.device)
        name = shares.names[target]
        made = sheets[name] = {
            method: saliency_sheet(model, probe, batch, target, method, f"{name}: {method}")
            for method in attribution.METHODS
        }
        if not checks:
            asked = np.full(len(batch), target)
            checks = attribution.sanity_check(model, probe, shares.shuffled, batch, asked, seeds=seeds)
            fresh, title = untrained_twin(model, 0), f"{name}: grad-cam with fresh weights"
            made["fresh weights"] = saliency_sheet(fresh, probe, batch, target, "grad-cam", title)
            unasked = {one: attribution.saliency("grad-cam", model, batch, one) for one in shares.factors}
            columns = {one: overlays(batch, seen) for one, seen in unasked.items()}
            columns = {"input": pictures(batch), **columns}
            made["feature"] = labelled_grid(columns, title="the feature itself", layout=LAYOUT)
        progress(place + 1, len(best))
    return sheets, checks


def safe_name(name: str) -> str:
    """A label as part of a file's name."""
    return re.sub(r"[^\w-]+", "-", name).strip("-")[:40] or "label"


MARKS = {"shuffled labels": "|", "untrained encoder": "x"}  # in the page's ink: visible on every bar
NAMED, LONGEST_NAME = 6, 24


def write_explanation(
    explained: Explained, out: Path, *, sheets: int, rows: int, progress: Callable[[int, int], object]
) -> Explained:
    """Write the folder of an explanation, whole or not at all: page, chart, sheets of maps, and probe.

    ``sheets`` labels get maps, best distinguished first, with so many ``rows`` of images; ``progress`` is
    called with (labels done, labels in all). Returns the explanation with ``checks``: how the maps answer to
    fresh weights. A FileExistsError: the folder holds other files.
    """
    require_replaceable(out, True, "explain.html")
    drawn, checks = draw_maps(explained, sheets, rows, progress)
    explained = replace(explained, checks=checks)
    chart = share_chart(explained.shares)
    with atomic_folder(out) as folder:
        (folder / "shares.svg").write_text(chart.svg(), encoding="utf-8")
        (folder / "shares.png").write_bytes(chart.png())
        for place, (name, made) in enumerate(drawn.items(), 1):
            for method, sheet in made.items():
                sheet.save(folder / f"maps-{place}-{safe_name(name)}-{safe_name(method)}.png")
        explained.shares.probe.save(folder / "probe")
        explanation_page(explained, drawn).write(folder / "explain.html")
    return explained


def explanation_page(explained: Explained, sheets: Mapping[str, Mapping[str, Image.Image]]) -> Page:
    """One self-contained page, with sheets of maps by label and method."""
    shares, images, checks = explained.shares, explained.images, explained.checks
    count = len(shares.names)
    asked = ", ".join(shares.names[:NAMED]) + (f" and {count - NAMED} more" if count > NAMED else "")
    if shares.kind == "labels" and count > 1:
        asked = f"{count} yes/no labels"
    names = () if (pair := explained.pair) is None else pair[0]
    shown = zip(pictures(images.images[[images.files.index(name) for name in names]]), names, strict=True)
    faces = [(face, f"the image {name}", name) for face, name in shown]
    values = {
        "shares": share_values(shares), "sheets": sheets, "unchanged": attribution.UNCHANGED,
        "tables": tables, "checks": checks, "clusters": explained.clusters, "pair": pair, "faces": faces,
    }  # fmt: skip
    lead = f"{explained.model.source or 'a model'} on {images.source}: {asked}."
    return Page("explanation.html", "Which factor made the answer", lead, values)


def share_values(result: tables.Explanation) -> dict[str, Any]:
    """What ``templates/shares.html`` shows: verdicts, the chart of the shares (SVG text) and their tables."""
    shown, verdicts = [tables.share_table(result), tables.drop_table(result)], tables.share_verdicts(result)
    return {"verdicts": verdicts, "chart": share_chart(result).svg(), "tables": shown}


def share_chart(result: tables.Explanation) -> Chart:
    """A panel for each factor, a bar for each question."""
    model, *controls = result.rows
    places = np.arange(len(result.names))[::-1]
    names = [name if len(name) <= LONGEST_NAME else f"{name[: LONGEST_NAME - 1]}…" for name in result.names]

    def draw(axes: Axes, factor: int) -> None:
        shares = model.shares[:, :, factor]
        share, spread = shares.mean(axis=0), shares.std(axis=0)
        whiskers = np.fmax((share - model.low[:, factor], model.high[:, factor] - share), spread)
        axes.barh(places, share, height=0.7, color=SERIES[factor % len(SERIES)], alpha=0.85)
        axes.errorbar(share, places, xerr=whiskers, fmt="none", ecolor=INK, elinewidth=1)
        for row in controls:
            axes.plot(
                row.shares[:, :, factor].mean(axis=0), places, MARKS[row.name],
                color=INK, markersize=7, markeredgewidth=1.6, label=row.name,
            )  # fmt: skip
        axes.set_yticks(places, names)
        axes.set_ylim(-0.7, len(places) - 0.3)
        axes.tick_params(axis="y", length=0)
        axes.grid(True, axis="x")
        axes.set_axisbelow(True)

    panels = {name: at for at, name in enumerate(result.factors)}
    return side_by_side(panels, draw, "share of |IG|", (1.6 + 2.0 * len(panels), 1.3 + 0.24 * len(places)))
