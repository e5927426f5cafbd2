"""The report of a training run: curves, samples, settings, versions and what failed, from its folder alone.

With evidence (``evidence``: data, decompositions, films, scores, card, explanation) it tells that too.
"""

import json
from collections.abc import Sequence
from io import BytesIO
from math import isfinite
from pathlib import Path
from typing import Any

from jaxtyping import Float
from PIL import Image
from torch import Tensor

from derender.baselines import read_any_config
from derender.model import Derenderer
from derender.report import blocks, charts
from derender.report.decomposition import decompose_images
from derender.report.evidence import Evidence
from derender.report.page import Page, Section
from derender.settings import Settings
from derender.training.config import TrainConfig, setting_names
from derender.training.run_folder import RunFolder, read_metrics

SHEETS_SHOWN, SHEET_PX = 4, 1080
CHARTS = (
    ("l1", "L1", "Mean absolute difference between picture and rendering, inside the mask."),
    (
        "loss",
        "loss",
        "What is minimised, on held-out pictures. With a confidence net it can fall below zero: the "
        "logarithm of sigma is part of it.",
    ),
)
BASELINE_CHARTS = (
    ("l1", "L1", "Mean absolute difference between picture and reconstruction."),
    ("loss", "loss", "What held-out pictures are judged by."),
)


def decomposition_sheet(model: Derenderer, pictures: Float[Tensor, "n 3 h w"]) -> Image.Image:
    """What the model makes of some pictures: a labelled panel with a row for each."""
    return decompose_images(model, pictures).sheet()


def run_page(folder: str | Path, evidence: Evidence | None = None) -> Page:
    """The page of a run folder, finished or not, with what else was found out about its model."""
    run = RunFolder(Path(folder))
    config = read_any_config(run.path)
    charts_wanted = CHARTS if isinstance(config, TrainConfig) else BASELINE_CHARTS
    metrics = read_metrics(run.path)
    environment = _read_environment(run.path / "environment.json")
    tree = config.model_dump(mode="json")
    settings = {name: _at(tree, name) for name in setting_names(type(config))}
    evidence = evidence or Evidence(())
    sections = [
        Section("How it went", [*_course(metrics, config), *loss_charts(metrics, charts_wanted)], "Training"),
        Section("Held-out pictures through time", _samples(run), "Samples"),
        *evidence.sections,
        Section("What failed", _failures(run, config, metrics, evidence), "Failed"),
        Section(
            "Settings and versions",
            [blocks.folded("All settings", blocks.facts(settings)), blocks.facts(environment)],
            "Settings",
        ),
    ]
    return Page(
        f"Training run {run.path.name}",
        _subtitle(config),
        [section for section in sections if section.blocks],
        f"derender {environment.get('derender', '')}".strip(),
    )


def trained_pictures(folder: str | Path) -> int | None:
    """How many pictures a run was given, those held out included; None where it does not say."""
    count = _read_environment(Path(folder) / "environment.json").get("pictures")
    return count if isinstance(count, int) else None


def _subtitle(config: Settings) -> str:
    if isinstance(config, TrainConfig):
        return f"Preset {config.preset}, LOOCC {config.objective.loocc}, seed {config.seed}."
    values = config.model_dump()
    return f"Baseline {values['baseline']}, seed {values['seed']}."


def loss_charts(
    metrics: Sequence[dict[str, Any]], wanted: Sequence[tuple[str, str, str]] = CHARTS
) -> list[blocks.Html]:
    """The total loss and the reconstruction error over pictures seen, training beside held-out."""
    charts_made = []
    for key, label, text in wanted:
        series = {}
        for kind, name in (("train", "training"), ("validation", "held out")):
            points = [
                (row["images"], row[key])
                for row in metrics
                if row.get("kind") == kind and _number(row.get(key))
            ]
            if points:
                series[name] = tuple(zip(*points, strict=True))
        if any(len(x) > 1 for x, _ in series.values()):  # one point is no curve
            svg = charts.curves(series, "pictures seen", label)
            charts_made.append(blocks.chart(svg, f"{label} over pictures seen", text))
    return charts_made


def _course(metrics: Sequence[dict[str, Any]], config: Settings) -> list[blocks.Html]:
    if not metrics:
        return [blocks.prose("Nothing was logged yet.")]
    last = metrics[-1]
    speeds = [row["images_per_second"] for row in metrics if _number(row.get("images_per_second"))]
    facts = {"pictures seen": f"{last['images']:,}", "minutes": f"{last.get('seconds', 0) / 60:.1f}"}
    if speeds:
        facts["pictures per second"] = f"{speeds[-1]:.0f}"
    judged = [row for row in metrics if row.get("kind") == "validation" and _number(row.get("loss"))]
    if judged and getattr(config, "keep", None) == "best":
        best = min(judged, key=lambda row: row["loss"])
        facts["weights of the model"] = f"after {best['images']:,} pictures, the best on held-out ones"
    return [blocks.facts(facts), *_stopped(metrics)]


def _stopped(metrics: Sequence[dict[str, Any]]) -> list[blocks.Html]:
    """What the watcher said when it stopped the run; usually nothing."""
    return [
        blocks.prose(blocks.strong("The watcher stopped this run. "), str(text))
        for row in metrics
        if row.get("kind") == "collapse"
        for sign, text in row.items()
        if sign not in ("kind", "images", "seconds")
    ]


def _failures(
    run: RunFolder, config: Any, metrics: Sequence[dict[str, Any]], evidence: Evidence
) -> list[blocks.Html]:
    """Everything that went wrong, was cut short or could not be told."""
    lines = _stopped(metrics)
    seen, planned = (metrics[-1]["images"] if metrics else 0), getattr(config, "images", 0)
    if seen < planned:
        lines.append(
            blocks.prose(
                f"{seen:,} of {planned:,} planned pictures were seen: it was stopped (time limit, patience, "
                "watcher or Ctrl-C), or is not done."
            )
        )
    if not run.model.exists():
        lines.append(blocks.prose("There is no saved model: no validation was reached."))
    unread = sum(1 for row in metrics if any(isinstance(v, float) and not isfinite(v) for v in row.values()))
    if unread:
        lines.append(blocks.prose(f"{unread:,} logged rows hold a number that is not finite."))
    lines += [blocks.prose(blocks.strong("Not on this page. "), reason) for reason in evidence.failed]
    return lines or [blocks.prose("Nothing that was noticed.")]


def _samples(run: RunFolder) -> list[blocks.Html]:
    sheets = sorted(run.samples.glob("*.png"))
    if len(sheets) > SHEETS_SHOWN:  # first, last and evenly between
        step = (len(sheets) - 1) / (SHEETS_SHOWN - 1)
        sheets = [sheets[round(index * step)] for index in range(SHEETS_SHOWN)]
    made = []
    for sheet in sheets:
        seen = f"{int(sheet.stem):,}" if sheet.stem.isdigit() else sheet.stem
        alt = f"decompositions after {seen} pictures"
        made.append(
            blocks.figure(blocks.wide(blocks.image(_smaller(sheet), alt), alt), f"After {seen} pictures.")
        )
    return made


def _smaller(sheet: Path) -> bytes:
    """A sheet as JPEG at most ``SHEET_PX`` wide: several lie on one page."""
    stream = BytesIO()
    with Image.open(sheet) as drawn:
        small = drawn.convert("RGB")
        small.thumbnail((SHEET_PX, 16 * SHEET_PX), Image.Resampling.LANCZOS)
        small.save(stream, format="JPEG", quality=86)
    return stream.getvalue()


def _read_environment(file: Path) -> dict[str, Any]:
    if not file.is_file():
        return {}
    try:
        values = json.loads(file.read_text())
    except json.JSONDecodeError:
        return {"environment.json": "damaged"}
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= value if isinstance(value, dict) else {key: value}
    return {key: value for key, value in flat.items() if value is not None}


def _at(tree: Any, dotted: str) -> Any:
    for part in dotted.split("."):
        tree = tree[part]
    return tree


def _number(value: object) -> bool:
    return isinstance(value, int | float) and value == value and abs(value) != float("inf")
