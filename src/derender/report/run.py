"""The report of a training run, from its folder alone: curves, samples, settings, versions, failures.

With ``evidence`` (data, decompositions, films, scores, card, explanation) the page holds that, too.
"""

from collections.abc import Callable, Mapping, Sequence
from io import BytesIO
from math import isfinite
from pathlib import Path
from typing import Any

from jaxtyping import Float
from PIL import Image
from torch import Tensor

from derender.baselines.training import read_any_config
from derender.model import Derenderer
from derender.report import blocks, charts, colours
from derender.report.decomposition import decompose_images
from derender.report.evidence import Evidence, recorded_environment
from derender.report.page import Page, Section
from derender.report.panel import labelled_grid
from derender.settings import Settings
from derender.training.config import TrainConfig, setting_names
from derender.training.run_folder import RunFolder, read_metrics

SHEETS_SHOWN, SHEET_PX = 4, 1080
Columns = Callable[[Any, Tensor], Mapping[str, Tensor]]
CHARTS = (
    ("l1", "L1", "Mean absolute difference between image and reconstruction, inside the mask."),
    (
        "loss",
        "loss",
        "Minimised loss, on held-out images. With a confidence net it can fall below zero: the logarithm "
        "of sigma is part of it.",
    ),
)
BASELINE_CHARTS = (
    ("l1", "L1", "Mean absolute difference between image and reconstruction."),
    ("loss", "loss", "Validation loss on held-out images."),
)


def decomposition_sheet(model: Derenderer, pictures: Float[Tensor, "n 3 h w"]) -> Image.Image:
    """Decompositions of some images: a labelled panel with a row for each."""
    return decompose_images(model, pictures).sheet()


def baseline_sheet(columns_of: Columns) -> Callable[[Any, Float[Tensor, "n 3 h w"]], Image.Image]:
    """A function of a baseline and images (0..1) that draws a row for each image, a column for each kind."""

    def sheet(model: Any, pictures: Float[Tensor, "n 3 h w"]) -> Image.Image:
        columns = columns_of(model, pictures)
        return labelled_grid({name: colours.pictures(values) for name, values in columns.items()})

    return sheet


def run_page(folder: str | Path, evidence: Evidence | None = None) -> Page:
    """The page of a run folder, finished or not, with other evidence on its model."""
    run, evidence = RunFolder(Path(folder)), evidence or Evidence(())
    config = read_any_config(run.path)
    metrics, environment = read_metrics(run.path), recorded_environment(run.path)
    tree = config.model_dump(mode="json")
    settings = {name: _at(tree, name) for name in setting_names(type(config))}
    charted = CHARTS if isinstance(config, TrainConfig) else BASELINE_CHARTS
    sections = [
        Section("Training", [*_course(metrics, config), *loss_charts(metrics, charted)], "Training"),
        Section("Held-out images through time", _samples(run), "Samples"),
        *evidence.sections,
        Section("Failures", _failures(run, config, metrics, evidence), "Failures"),
        Section(
            "Settings and versions",
            [blocks.folded("All settings", blocks.facts(settings)), blocks.facts(environment)],
            "Settings",
        ),
    ]
    named = "preset" if isinstance(config, TrainConfig) else "baseline"
    lead = f"{named.capitalize()} {tree[named]}, seed {tree['seed']}."
    if isinstance(config, TrainConfig):
        lead = f"Preset {config.preset}, LOOCC {config.objective.loocc}, seed {config.seed}."
    shown = [section for section in sections if section.blocks]
    version = f"derender {environment.get('derender', '')}".strip()
    return Page(f"Training run {run.path.name}", lead, shown, version)


def loss_charts(
    metrics: Sequence[Mapping[str, Any]], charted: Sequence[tuple[str, str, str]] = CHARTS
) -> list[blocks.Html]:
    """The total loss and the reconstruction error over images seen, training beside held-out."""
    made = []
    for key, label, text in charted:
        series = {}
        for kind, name in (("train", "training"), ("validation", "held out")):
            rows = [row for row in metrics if row.get("kind") == kind and _finite(row.get(key))]
            if rows:
                series[name] = ([row["images"] for row in rows], [row[key] for row in rows])
        if any(len(x) > 1 for x, _ in series.values()):  # one point is no curve
            svg = charts.curves(series, "images seen", label)
            made.append(blocks.chart(svg, f"{label} over images seen", text))
    return made


def _course(metrics: Sequence[Mapping[str, Any]], config: Settings) -> list[blocks.Html]:
    if not metrics:
        return [blocks.prose("Nothing was logged yet.")]
    last = metrics[-1]
    facts = {"images seen": f"{last['images']:,}", "minutes": f"{last.get('seconds', 0) / 60:.1f}"}
    speeds = [row["images_per_second"] for row in metrics if _finite(row.get("images_per_second"))]
    if speeds:
        facts["images per second"] = f"{speeds[-1]:.0f}"
    validated = [row for row in metrics if row.get("kind") == "validation" and _finite(row.get("loss"))]
    if validated and getattr(config, "keep", None) == "best":
        best = min(validated, key=lambda row: row["loss"])
        facts["weights of the model"] = f"after {best['images']:,} images, the best on held-out ones"
    return [blocks.facts(facts), *_stopped(metrics)]


def _stopped(metrics: Sequence[Mapping[str, Any]]) -> list[blocks.Html]:
    """The watcher's reasons to stop the run; usually none."""
    return [
        blocks.prose(blocks.strong("The watcher stopped this run. "), str(text))
        for row in metrics
        if row.get("kind") == "collapse"
        for sign, text in row.items()
        if sign not in ("kind", "images", "seconds")
    ]


def _failures(
    run: RunFolder, config: Any, metrics: Sequence[Mapping[str, Any]], evidence: Evidence
) -> list[blocks.Html]:
    """Everything that went wrong, was cut short or could not be made."""
    lines = _stopped(metrics)
    seen, planned = (metrics[-1]["images"] if metrics else 0), getattr(config, "images", 0)
    if seen < planned:
        lines.append(
            blocks.prose(
                f"{seen:,} of {planned:,} planned images were seen: the run was stopped (time limit, "
                "patience, watcher or Ctrl-C), or goes on."
            )
        )
    if not run.model.exists():
        lines.append(blocks.prose("There is no saved model: no validation was reached."))
    rows = sum(1 for row in metrics if any(isinstance(v, float) and not isfinite(v) for v in row.values()))
    if rows:
        lines.append(blocks.prose(f"{rows:,} logged rows hold NaN or infinity."))
    lines += [blocks.prose(blocks.strong("Not on this page. "), reason) for reason in evidence.failed]
    return lines or [blocks.prose("None was noticed.")]


def _samples(run: RunFolder) -> list[blocks.Html]:
    sheets = sorted(run.samples.glob("*.png"))
    if len(sheets) > SHEETS_SHOWN:  # first, last and evenly between
        step = (len(sheets) - 1) / (SHEETS_SHOWN - 1)
        sheets = [sheets[round(index * step)] for index in range(SHEETS_SHOWN)]
    made = []
    for sheet in sheets:
        seen = f"{int(sheet.stem):,}" if sheet.stem.isdigit() else sheet.stem
        alt = f"decompositions after {seen} images"
        shown = blocks.wide(blocks.image(_smaller(sheet), alt), alt)
        made.append(blocks.figure(shown, f"After {seen} images."))
    return made


def _smaller(sheet: Path) -> bytes:
    """A sheet as JPEG at most ``SHEET_PX`` wide: several lie on one page."""
    stream = BytesIO()
    with Image.open(sheet) as drawn:
        small = drawn.convert("RGB")
        small.thumbnail((SHEET_PX, 16 * SHEET_PX), Image.Resampling.LANCZOS)
        small.save(stream, format="JPEG", quality=86)
    return stream.getvalue()


def _at(tree: Any, dotted: str) -> Any:
    for part in dotted.split("."):
        tree = tree[part]
    return tree


def _finite(value: object) -> bool:
    return isinstance(value, int | float) and isfinite(value)
