"""The report of a training run: its curves, samples, settings, versions and failures, and its images.

Given images, the page also has data, decompositions, films, scores, card and factors. Every part looks at few
images, so that a page takes minutes; ``derender evaluate`` and ``derender explain`` measure with more. A part
that cannot be made is listed with its reason. The doctor's findings are also a page by themselves. Both hold
images of the set: share them as you would the set itself.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from derender import __version__
from derender.baselines import read_any_config
from derender.data import GroundTruth, ImageSet, Progress, as_float, read_ground_truth, split_indices
from derender.data.doctor import CHECKS, EXAMINED_PX, Examination, doctor
from derender.data.image import read_photo
from derender.data.source import evenly_spaced
from derender.evaluation.disentanglement import disentangle
from derender.evaluation.pixels import evaluate_reconstruction, mean_image
from derender.evaluation.score_table import Column, Row, ScoreTable
from derender.evaluation.truth import evaluate_factors, evaluate_geometry
from derender.inputs import as_images, as_model
from derender.interpretation import explain
from derender.model import Derenderer
from derender.overrides import settings_by_name
from derender.report import charts, colours
from derender.report.decomposition import COLUMN_MEANING, decompose_images
from derender.report.explanation import share_values
from derender.report.opening import readable
from derender.report.page import Page
from derender.report.panel import labelled_grid, strip
from derender.report.sweeps import animated_png, relit_and_rotated
from derender.storage.bounded import read_json
from derender.storage.places import counted
from derender.training.config import TrainConfig
from derender.training.run_folder import RunFolder, read_metrics

SHEETS_SHOWN, SHEET_PX, SHEET_PIXEL_LIMIT = 4, 1080, 20_000_000
Metrics = Sequence[Mapping[str, Any]]
CHARTS = {
    "l1": ("L1", "Mean absolute difference of image and reconstruction, inside the mask if there is one."),
    "loss": ("loss", "Minimised loss, on held-out images. With a confidence net it can fall below zero: the "
             "logarithm of sigma is part of it."),
}  # fmt: skip
EXAMINED, SCORED, CARD, EXPLAINED = 1_500, 200, 200, 400  # images each part looks at, at most
SHOWN, FILMED, TRUTH_SHOWN = 5, 2, 100
FEWEST_OF_A_CLASS, MOST_CLASSES = 10, 12

Values = dict[str, Any]  # what a section of ``templates/run.html`` shows, by name


@dataclass(frozen=True)
class Evidence:
    """Values of sections by name, and a sentence for each part that is missing, with the reason."""

    sections: Mapping[str, Values] = field(default_factory=dict)
    failed: Sequence[str] = ()


@dataclass(frozen=True)
class Subject:
    """A trained model and images of its size to report on.

    ``held_out`` are those it was not trained on, or all where they are of another set; ``which`` describes
    them. ``truth`` are rendered images with exact maps, ``labels`` columns to explain by factors.
    """

    model: Derenderer
    images: ImageSet
    held_out: ImageSet
    which: str
    truth: GroundTruth | None = None
    labels: Sequence[str] = ()


def sample_sheet(model: Any, pictures: Float[Tensor, "n 3 h w"]) -> Image.Image:
    """Decompositions of some images (0..1), or what a baseline shows of them: a row for each."""
    if isinstance(model, Derenderer):
        return decompose_images(model, pictures).sheet()
    return labelled_grid({name: colours.pictures(values) for name, values in model.shown(pictures).items()})


def run_page(folder: str | Path, evidence: Evidence | None = None) -> Page:
    """The page of a run folder, finished or not, with other evidence on its model."""
    run, config = RunFolder(Path(folder)), read_any_config(Path(folder))
    metrics, environment = read_metrics(run.path), recorded_environment(run.path)
    settings = settings_by_name(config.model_dump(mode="json"))
    validated = _finite_rows(metrics, "loss", "validation")
    broken = [row for row in metrics if any(isinstance(v, float) and not isfinite(v) for v in row.values())]
    samples, unread = _samples(run)
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
        "evidence": evidence or Evidence(),
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
    """Sheets as JPEG, first, last and evenly between, with the images seen; why others cannot be drawn."""

    def read(sheet: Path) -> tuple[bytes, str]:
        small = Image.fromarray(read_photo(sheet, SHEET_PIXEL_LIMIT))
        small.thumbnail((SHEET_PX, 16 * SHEET_PX), Image.Resampling.LANCZOS)
        seen = f"{int(sheet.stem):,}" if sheet.stem.isdigit() else sheet.stem
        return colours.image_bytes(small, "JPEG", quality=86), seen

    sheets = sorted(run.samples.glob("*.png"))
    shown = [sheets[place] for place in evenly_spaced(len(sheets), SHEETS_SHOWN)]
    made, unread = readable(shown, read, needed=False)
    return list(made.values()), list(unread.values())


def _finite_rows(metrics: Metrics, name: str, kind: str | None = None) -> Metrics:
    """Rows, of one kind or any, in which this is a number."""
    some = (row for row in metrics if kind in (None, row.get("kind")))
    return [row for row in some if isinstance(row.get(name), int | float) and isfinite(row[name])]


def run_evidence(
    run: str | Path, images: ImageSet | str | Path, *, truth: str | Path | None = None,
    labels: Sequence[str] = (), dataset: str = "auto", limit: int | None = None, device: str = "auto",
    progress: Progress | None = None,
) -> Evidence:  # fmt: skip
    """Everything that can be reported of a run's model and images.

    A run without a model (a baseline, a collapse, a run that has just begun) has only its images examined.

    Args:
        images: a set of images or its address, read by ``dataset`` and ``limit``: its own, or others.
        truth: address of rendered images with exact depth, to score geometry.
        labels: columns to explain by factors; by default the first suitable one.
        device: "auto", "cpu" or "cuda".
        progress: called with (parts done, parts in all).
    """
    try:
        model, missing = as_model(run, device=device), ""
    except (ValueError, FileNotFoundError) as reason:
        model, missing = None, f"Everything about the model: {reason}"
    size = EXAMINED_PX if model is None else model.image_size
    images = as_images(images, size, dataset=dataset, limit=limit)
    for name in labels:
        images.label(name)
    if model is None:
        return Evidence({"data": look_at_data(images)}, [missing])
    held_out, which = _held_out(Path(run), images)
    known = None if truth is None else read_ground_truth(truth, limit=TRUTH_SHOWN, image_size=size)
    return gather(Subject(model, images, held_out, which, known, labels), progress)


def _held_out(run: Path, images: ImageSet) -> tuple[ImageSet, str]:
    """The images that the run did not train on, if these are its own; otherwise all."""
    config = read_any_config(run)
    if len(images) != recorded_environment(run).get("pictures"):
        return images, f"All {len(images):,} images of {images.source}; the run was trained with others"
    split = split_indices(images.files, config.split, seed=config.seed)
    for name in ("test", "validation"):
        if len(rows := getattr(split, name)):
            return images.select(rows), f"The {len(rows):,} images of the run's {name} part"
    return images, "The images it was trained with, since it held none back"


def recorded_environment(run: Path) -> dict[str, Any]:
    """The versions, device and counts that a run recorded, in one level; empty where it recorded none."""
    file = run / "environment.json"
    if not file.is_file():
        return {}
    try:
        values = read_json(file, dict[str, Any])
    except ValueError:
        return {file.name: "damaged"}
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= value if isinstance(value, dict) else {key: value}
    return {key: value for key, value in flat.items() if value is not None}


def look_at_data(images: ImageSet) -> Values:
    """The doctor's findings on a sample of the images."""
    sample = _sample(images, EXAMINED)
    size = f"All {len(sample):,} images" if len(sample) == len(images) else f"{len(sample):,} images"
    return {"source": images.describe(), "size": size, "found": doctor_values(doctor(sample))}


def doctor_page(examination: Examination) -> Page:
    """The whole page for one set of images."""
    return Page(
        "doctor.html",
        "Does this set suit the method?",
        f"{examination.images.describe()}. Examined without training anything.",
        {"found": doctor_values(examination)},
        f"derender {__version__}. This page holds images of the set: share it as you would the set itself.",
    )


def doctor_values(examination: Examination) -> dict[str, Any]:
    """What ``templates/findings.html`` shows of an examination."""
    images, mean = examination.images, examination.mean
    mirrored = [] if mean is None else colours.pictures(np.stack([mean, mean[..., ::-1]]))
    notes = {"value": "", "±": "two standard errors", "will struggle": "limit", "does not suit": "limit"}
    rows = []
    for name, check in CHECKS.items():
        if (one := examination.values.get(name)) is not None:
            cells = (one.value, 2 * one.error or None, check.struggles, check.objects)
            rows.append(Row(check.label, cells, note=check.note))
    compared = 0 if examination.shared is None else len(examination.shared.rows)
    caption = f"{counted(len(images), 'images')}, {compared:,} distinct ones compared"
    columns = [Column(name, None, 3, note) for name, note in notes.items()]
    return {
        "examination": examination,
        "least": CHECKS["agreement"].struggles,
        "mean": [colours.enlarged(image, 128) for image in mirrored],
        "strips": {
            title: strip(colours.pictures(images.images[list(some)]), gap=4)
            for title, some in examination.examples.items()
        },
        "measures": ScoreTable(caption, "measure", columns, rows),
    }


def gather(subject: Subject, progress: Progress | None = None) -> Evidence:
    """Every section that can be made; ``progress`` is called with (parts done, parts in all)."""
    parts: dict[str, tuple[str, Callable[[Subject], Values]]] = {
        "data": ("The data", lambda subject: look_at_data(subject.images)),
        "decomposed": ("Held-out images, decomposed", _decomposed),
        "films": ("Light and view moved", _films),
        "scores": ("Scores beside controls", _scores),
        "card": ("Does each feature hold its own factor?", _card),
        "explained": ("Labels explained by factors", _explained),
    }
    progress, sections, failed = progress or (lambda done, total: None), {}, []
    progress(0, len(parts))
    for done, (name, (title, make)) in enumerate(parts.items(), 1):
        try:
            sections[name] = make(subject)
        except ValueError as reason:
            failed.append(f"{title}: {reason}")
        progress(done, len(parts))
    return Evidence(sections, failed)


def _decomposed(subject: Subject) -> Values:
    sample = _sample(subject.held_out.require(1, "a decomposition"), SHOWN)
    drawn = decompose_images(subject.model, as_float(sample.images).to(subject.model.device))
    names = [Path(name).name for name in sample.files]
    return {"which": subject.which, "columns": drawn.columns, "names": names, "meaning": COLUMN_MEANING}


def _films(subject: Subject) -> Values:
    sample = _sample(subject.held_out.require(1, "a film"), SHOWN).select(slice(FILMED))
    return {"films": looping_films(subject.model, sample.images, [Path(name).name for name in sample.files])}


def looping_films(
    model: Derenderer, images: UInt8[np.ndarray, "n 3 h w"], names: Sequence[str]
) -> list[tuple[bytes, Any, str]]:
    """A film of each image with a still and its name: the light goes round, the object rotates."""
    with torch.no_grad():
        scenes = model.decompose(as_float(images).to(model.device))
    loops = [relit_and_rotated(scenes[index], model.render) for index in range(len(names))]
    shown = zip(loops, names, strict=True)
    return [(animated_png(frames), frames[len(frames) // 4], name) for frames, name in shown]


def _scores(subject: Subject) -> Values:
    """Reconstruction beside the mean image and, on rendered data, geometry beside its controls."""
    sample = _sample(subject.held_out.require(1, "a score"), SCORED)
    again = evaluate_reconstruction(subject.model, sample.images, mean=mean_image(subject.images.images))
    tables, truth = [], subject.truth
    if truth is not None:
        tables.append(evaluate_geometry(subject.model, truth).table())
        if truth.albedo is not None and truth.light is not None and truth.camera is not None:
            tables.append(evaluate_factors(subject.model, truth).table())
    return {"which": subject.which, "tables": [*tables, again.table()], "depth_known": truth is not None}


def _card(subject: Subject) -> Values:
    """The disentanglement card from one seed, without scores by dimension."""
    sample = _sample(subject.held_out, CARD)
    how = {"seeds": (0,), "dimensions": None, "swap_images": min(64, len(sample)), "cache": "none"}
    result = disentangle(subject.model, sample, **how)
    sheet = charts.matrix_sheet(charts.card_matrices(result.result))
    return {"notes": ". ".join(result.notes[:2]), "tables": result.tables[:3], "matrices": sheet}


def _explained(subject: Subject) -> Values:
    """Shares of the factors in the predictions of a probe, beside controls."""
    names = tuple(subject.labels) or suitable_label(subject.held_out)
    if not names:
        known = ", ".join(subject.held_out.labels) or "none"
        raise ValueError(f"no label of 2 to {MOST_CLASSES} classes (labels: {known}): name one")
    sample = _sample(subject.held_out, EXPLAINED)
    result = explain(replace(sample, partition=None), subject.model, names, seeds=1).shares
    shares = share_values(result)
    return {"count": f"{len(sample):,}", "names": ", ".join(names), "shares": shares}


def suitable_label(images: ImageSet) -> tuple[str, ...]:
    """The first column of text with few classes that each have enough images; empty for none."""
    for name, column in images.labels.items():
        if column.dtype.kind in "USO":
            values, counts = np.unique(column[column != ""].astype(str), return_counts=True)
            if 2 <= len(values) <= MOST_CLASSES and counts.min() >= FEWEST_OF_A_CLASS:
                return (name,)
    return ()


def _sample(images: ImageSet, most: int) -> ImageSet:
    """At most so many images, evenly through the set."""
    return images.select(evenly_spaced(len(images), most))
