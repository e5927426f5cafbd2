"""The report of a training run, made from its folder alone: curves, samples, settings, versions."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxtyping import Float
from PIL import Image
from torch import Tensor

from derender.baselines.training import read_any_config
from derender.model import Derenderer
from derender.report import blocks, charts
from derender.report.figures import decomposition
from derender.report.page import Page, Section
from derender.settings import Settings
from derender.training.config import TrainConfig, setting_names
from derender.training.run_folder import RunFolder, read_metrics

SHEETS_SHOWN = 4
CHARTS = (
    ("l1", "L1", "Mean absolute difference between picture and rendering, inside the mask."),
    ("loss", "loss", "What is minimised; it can fall below zero, because confidence enters as a logarithm."),
)
BASELINE_CHARTS = (
    ("l1", "L1", "Mean absolute difference between picture and reconstruction."),
    ("loss", "loss", "What held-out pictures are judged by."),
)


def decomposition_sheet(model: Derenderer, pictures: Float[Tensor, "n 3 h w"]) -> Image.Image:
    """What the model makes of some pictures: a labelled panel with a row for each."""
    return decomposition(pictures, model.decompose(pictures), model.render, model.fov_deg).sheet()


def run_page(folder: str | Path) -> Page:
    """The page of a run folder, finished or not."""
    run = RunFolder(Path(folder))
    config = read_any_config(run.path)
    charts_wanted = CHARTS if isinstance(config, TrainConfig) else BASELINE_CHARTS
    metrics = read_metrics(run.path)
    environment = _read_environment(run.path / "environment.json")
    tree = config.model_dump(mode="json")
    settings = {name: _at(tree, name) for name in setting_names(type(config))}
    sections = [
        Section("How it went", [*_course(metrics), *loss_charts(metrics, charts_wanted)], "Training"),
        Section("Held-out pictures through time", _samples(run), "Samples"),
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


def _course(metrics: Sequence[dict[str, Any]]) -> list[blocks.Html]:
    if not metrics:
        return [blocks.prose("Nothing was logged yet.")]
    last = metrics[-1]
    speeds = [row["images_per_second"] for row in metrics if _number(row.get("images_per_second"))]
    facts = {"pictures seen": f"{last['images']:,}", "minutes": f"{last.get('seconds', 0) / 60:.1f}"}
    if speeds:
        facts["pictures per second"] = f"{speeds[-1]:.0f}"
    collapse = [row for row in metrics if row.get("kind") == "collapse"]
    told = [
        blocks.prose(blocks.strong("The watcher stopped this run. "), str(text))
        for row in collapse
        for sign, text in row.items()
        if sign not in ("kind", "images", "seconds")
    ]
    return [blocks.facts(facts), *told]


def _samples(run: RunFolder) -> list[blocks.Html]:
    sheets = sorted(run.samples.glob("*.png"))
    if len(sheets) > SHEETS_SHOWN:  # first, last and evenly between
        step = (len(sheets) - 1) / (SHEETS_SHOWN - 1)
        sheets = [sheets[round(index * step)] for index in range(SHEETS_SHOWN)]
    made = []
    for sheet in sheets:
        seen = f"{int(sheet.stem):,}" if sheet.stem.isdigit() else sheet.stem
        image = blocks.image(sheet.read_bytes(), f"decompositions after {seen} pictures")
        made.append(blocks.figure(image, f"After {seen} pictures."))
    return made


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
