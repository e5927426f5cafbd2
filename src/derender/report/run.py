"""The report of a training run, from its folder alone: curves, samples, settings, versions, failures.

With ``evidence`` (data, decompositions, films, scores, card, explanation) the page holds that, too.
"""

from collections.abc import Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import Any

from jaxtyping import Float
from PIL import Image
from torch import Tensor

from derender.baselines import read_any_config
from derender.data import read_photo
from derender.data.source import evenly_spaced
from derender.model import Derenderer
from derender.overrides import settings_by_name
from derender.report import charts, colours
from derender.report.colours import image_bytes
from derender.report.decomposition import decompose_images
from derender.report.evidence import Evidence, recorded_environment
from derender.report.page import Page
from derender.report.panel import labelled_grid
from derender.training.config import TrainConfig
from derender.training.run_folder import RunFolder, read_metrics

SHEETS_SHOWN, SHEET_PX, SHEET_PIXEL_LIMIT = 4, 1080, 20_000_000
Metrics = Sequence[Mapping[str, Any]]
CHARTS = {
    "l1": ("L1", "Mean absolute difference of image and reconstruction, inside the mask if there is one."),
    "loss": ("loss", "Minimised loss, on held-out images. With a confidence net it can fall below zero: the "
             "logarithm of sigma is part of it."),
}  # fmt: skip


def sample_sheet(model: Any, pictures: Float[Tensor, "n 3 h w"]) -> Image.Image:
    """Decompositions of some images (0..1), or what a baseline shows of them: a row for each."""
    if isinstance(model, Derenderer):
        return decompose_images(model, pictures).sheet()
    return labelled_grid({name: colours.pictures(values) for name, values in model.shown(pictures).items()})


def run_page(folder: str | Path, evidence: Evidence | None = None) -> Page:
    """The page of a run folder, finished or not, with other evidence on its model."""
    run, evidence = RunFolder(Path(folder)), evidence or Evidence()
    samples, unread = _samples(run)
    config = read_any_config(run.path)
    metrics, environment = read_metrics(run.path), recorded_environment(run.path)
    settings = settings_by_name(config.model_dump(mode="json"))
    validated = _finite_rows(metrics, "loss", "validation")
    broken = [row for row in metrics if any(isinstance(v, float) and not isfinite(v) for v in row.values())]
    values = {
        "last": metrics[-1] if metrics else None,
        "speeds": [row["images_per_second"] for row in _finite_rows(metrics, "images_per_second")],
        "best": min(validated, key=lambda row: row["loss"], default=None),
        "planned": getattr(config, "images", 0),
        "saved": run.model.exists(),
        "broken": len(broken),
        "watcher": [
            str(text)
            for row in metrics
            for sign, text in row.items()
            if row.get("kind") == "collapse" and sign not in ("kind", "images", "seconds")
        ],
        "charts": loss_charts(metrics),
        "samples": samples,
        "evidence": evidence,
        "unread": unread,
        "settings": settings,
        "environment": environment,
    }
    lead = f"Baseline {settings.get('baseline')}, seed {config.seed}."
    if isinstance(config, TrainConfig):
        lead = f"Preset {config.preset}, LOOCC {config.objective.loocc}, seed {config.seed}."
    version = f"derender {environment.get('derender', '')}".strip()
    return Page("run.html", f"Training run {run.path.name}", lead, values, version)


def loss_charts(metrics: Metrics) -> list[tuple[str, str, str]]:
    """The total loss and the reconstruction error over images seen, training beside held-out.

    Each is SVG text, its alternative text and its caption.
    """
    made = []
    for key, (label, text) in CHARTS.items():
        series = {}
        for kind, name in (("train", "training"), ("validation", "held out")):
            if rows := _finite_rows(metrics, key, kind):
                series[name] = ([row["images"] for row in rows], [row[key] for row in rows])
        if any(len(x) > 1 for x, _ in series.values()):  # one point is no curve
            made.append((charts.curves(series, "images seen", label), f"{label} over images seen", text))
    return made


def _samples(run: RunFolder) -> tuple[list[tuple[bytes, str]], list[str]]:
    """Sheets as JPEG at most ``SHEET_PX`` wide, first, last and evenly between, with the images seen; why
    others cannot be drawn.
    """
    sheets, made, unread = sorted(run.samples.glob("*.png")), [], []
    for place in evenly_spaced(len(sheets), SHEETS_SHOWN):
        name = sheets[place].stem
        try:
            small = Image.fromarray(read_photo(sheets[place], SHEET_PIXEL_LIMIT))
        except (ValueError, OSError) as problem:
            unread.append(str(problem))
            continue
        small.thumbnail((SHEET_PX, 16 * SHEET_PX), Image.Resampling.LANCZOS)
        shown_as = f"{int(name):,}" if name.isdigit() else name
        made.append((image_bytes(small, "JPEG", quality=86), shown_as))
    return made, unread


def _finite_rows(metrics: Metrics, name: str, kind: str | None = None) -> Metrics:
    """Rows, of one kind or any, in which this is a number."""
    some = (row for row in metrics if kind in (None, row.get("kind")))
    return [row for row in some if isinstance(row.get(name), int | float) and isfinite(row[name])]
