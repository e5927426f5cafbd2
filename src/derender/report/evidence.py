"""Sections for the page of a run once images are given: data, decompositions, films, scores, card, factors.

Every part looks at few images, so that a page takes minutes; ``derender evaluate`` and ``derender explain``
measure with more. A part that cannot be made is listed with its reason. Leaves out the run's own record
(``run``).
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8

from derender.baselines.controls import untrained_features
from derender.baselines.training import read_any_config
from derender.data import GroundTruth, ImageSet, as_float, read_ground_truth, split_indices
from derender.data.doctor import EXAMINED_PX, doctor
from derender.evaluation import evaluate_factors, evaluate_geometry, evaluate_reconstruction, mean_picture
from derender.evaluation.disentanglement import disentangle
from derender.evaluation.linear_task import choose_rows
from derender.features import embed_pictures
from derender.inputs import as_images, as_model
from derender.interpretation import explain_labels, question
from derender.model import Derenderer
from derender.report import blocks
from derender.report.blocks import Html
from derender.report.decomposition import COLUMN_MEANING, decompose_images
from derender.report.doctor import doctor_blocks
from derender.report.explanation import share_blocks, share_chart
from derender.report.films import animated_png
from derender.report.matrices import card_matrices, matrix_sheet
from derender.report.page import Section
from derender.report.sweeps import relit_and_rotated

EXAMINED, SCORED, CARD, EXPLAINED = 1_500, 200, 200, 400  # images each part looks at, at most
SHOWN, FILMED, TRUTH_SHOWN = 5, 2, 100
FILM_WIDTH = 256
FEWEST_OF_A_CLASS, MOST_CLASSES = 10, 12

Progress = Callable[[int, int], object]


@dataclass(frozen=True)
class Evidence:
    """Sections for a page, and a sentence for each part that is missing, with the reason."""

    sections: Sequence[Section]
    failed: Sequence[str] = ()


@dataclass(frozen=True)
class Subject:
    """A model and images to report on.

    Attributes:
        model: trained.
        images: all there are, at the model's size.
        held_out: those of them the model was not trained on, or all where they are of another set.
        which: a description of ``held_out``.
        truth: rendered images with exact maps, if there are any.
        labels: columns to explain by factors.
    """

    model: Derenderer
    images: ImageSet
    held_out: ImageSet
    which: str
    truth: GroundTruth | None = None
    labels: Sequence[str] = ()


def run_evidence(
    run: str | Path,
    images: ImageSet | str | Path,
    *,
    truth: str | Path | None = None,
    labels: Sequence[str] = (),
    dataset: str = "auto",
    limit: int | None = None,
    device: str = "auto",
    progress: Progress | None = None,
) -> Evidence:
    """Everything that can be reported of a run's model and images.

    A run without a model (a baseline, a collapse, a run that has just begun) has only its images examined.

    Args:
        run: a run folder.
        images: a set of images or its address: those it was trained with, or others.
        truth: address of rendered images with exact depth, to score geometry.
        labels: columns to explain by factors; by default the first suitable one.
        dataset, limit: how the address is read.
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
        return Evidence([Section("The data", look_at_data(images), "Data")], [missing])
    held_out, which = _held_out(Path(run), images)
    known = None
    if truth is not None:
        known = read_ground_truth(truth, limit=TRUTH_SHOWN, image_size=model.image_size)
    return gather(Subject(model, images, held_out, which, known, labels), progress)


def _held_out(run: Path, images: ImageSet) -> tuple[ImageSet, str]:
    """The images that the run did not train on, if these are its own; otherwise all."""
    config = read_any_config(run)
    if len(images) != recorded_environment(run).get("pictures"):
        return images, f"All {len(images):,} images of {images.source}; the run was trained with others"
    split = split_indices(images.files, config.split, seed=config.seed)
    for name in ("test", "validation"):
        rows = getattr(split, name)
        if len(rows):
            return images.select(rows), f"The {len(rows):,} images of the run's {name} part"
    return images, "The images it was trained with, since it held none back"


def recorded_environment(run: Path) -> dict[str, Any]:
    """The versions, device and counts that a run recorded, in one level; empty where it recorded none."""
    file = run / "environment.json"
    if not file.is_file():
        return {}
    try:
        values = json.loads(file.read_text())
    except json.JSONDecodeError:
        return {file.name: "damaged"}
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= value if isinstance(value, dict) else {key: value}
    return {key: value for key, value in flat.items() if value is not None}


def look_at_data(pictures: ImageSet) -> list[Html]:
    """The doctor's findings on a sample of the images."""
    sample = _sample(pictures, EXAMINED)
    size = f"All {len(sample):,} images" if len(sample) == len(pictures) else f"{len(sample):,} images"
    note = blocks.prose(f"{pictures.describe()}. {size} were examined, identical copies left out before.")
    return [note, *doctor_blocks(doctor(sample))]


def gather(subject: Subject, progress: Progress | None = None) -> Evidence:
    """Every section that can be made; ``progress`` is called with (parts done, parts in all)."""
    parts: dict[tuple[str, str], Callable[[], list[Html]]] = {
        ("The data", "Data"): lambda: look_at_data(subject.images),
        ("Held-out images, decomposed", "Decomposed"): lambda: _decomposed(subject),
        ("Light and view moved", "Films"): lambda: _films(subject),
        ("Scores beside controls", "Scores"): lambda: _scores(subject),
        ("Does each feature hold its own factor?", "Card"): lambda: _card(subject),
        ("Labels explained by factors", "Explained"): lambda: _explained(subject),
    }
    sections, failed = [], []
    for done, ((title, short), make) in enumerate(parts.items()):
        if progress is not None:
            progress(done, len(parts))
        try:
            sections.append(Section(title, make(), short))
        except ValueError as reason:
            failed.append(f"{title}: {reason}")
    if progress is not None:
        progress(len(parts), len(parts))
    return Evidence(sections, failed)


def _decomposed(subject: Subject) -> list[Html]:
    sample = _sample(subject.held_out.require(1, "a decomposition"), SHOWN)
    drawn = decompose_images(subject.model, as_float(sample.images).to(subject.model.device))
    caption = f"{subject.which}, evenly chosen by their order. Every column is made from the image alone."
    names = [Path(name).name for name in sample.files]
    return [
        blocks.image_grid(drawn.columns, names, caption, COLUMN_MEANING),
        blocks.definitions(COLUMN_MEANING),
    ]


def _films(subject: Subject) -> list[Html]:
    sample = _sample(subject.held_out.require(1, "a film"), SHOWN).select(slice(FILMED))
    names = [Path(name).name for name in sample.files]
    caption = "Only light or camera moves. Empty parts are those that the frontal view does not show."
    return [looping_films(subject.model, sample.images, names, caption)]


def looping_films(
    model: Derenderer, images: UInt8[np.ndarray, "n 3 h w"], names: Sequence[str], caption: str
) -> Html:
    """A film of each image: the light goes round, the object rotates."""
    with torch.no_grad():
        scenes = model.decompose(as_float(images).to(model.device))
    items = []
    for index, name in enumerate(names):
        frames = relit_and_rotated(scenes[index], model.render)
        alt = f"{name}: the light goes round, the object rotates"
        film = blocks.film(animated_png(frames), frames[len(frames) // 4], alt, FILM_WIDTH)
        items.append((film, name))
    return blocks.figure(blocks.row_of(items), caption)


def _scores(subject: Subject) -> list[Html]:
    """Reconstruction beside the mean image and, on rendered data, geometry beside its controls."""
    sample = _sample(subject.held_out.require(1, "a score"), SCORED)
    again = evaluate_reconstruction(subject.model, sample.images, mean=mean_picture(subject.images.images))
    tables = [again.table()]
    if subject.truth is not None:
        truth = subject.truth
        tables.insert(0, evaluate_geometry(subject.model, truth).table())
        if truth.albedo is not None and truth.light is not None and truth.camera is not None:
            tables.insert(1, evaluate_factors(subject.model, truth).table())
    made = [blocks.prose(f"{subject.which}; few of them, so that this page takes minutes.")]
    for table in tables:
        made += [blocks.prose(f"{table.columns[0].name}: {table.verdict(0)}."), blocks.table(table)]
    if subject.truth is None:
        made.append(
            blocks.prose(
                "These images have no exact depth, so whether the geometry is right cannot be scored here."
            )
        )
    return made


def _card(subject: Subject) -> list[Html]:
    """The disentanglement card from one seed, without scores by dimension."""
    sample = _sample(subject.held_out, CARD)
    found = disentangle(subject.model, sample, seeds=(0,), dimensions=None, swap_images=min(64, len(sample)))
    sheet = blocks.image(
        matrix_sheet(card_matrices(found.result)), "matrices of the features: correlation, CKA, swap test"
    )
    return [
        blocks.prose(f"{'. '.join(found.notes[:2])}."),
        *(blocks.table(table) for table in found.tables[:3]),
        blocks.folded("Matrices", sheet),
    ]


def _explained(subject: Subject) -> list[Html]:
    """Shares of the factors in the predictions of a probe, beside controls."""
    columns = subject.held_out.labels
    names = tuple(subject.labels) or suitable_label(subject.held_out)
    if not names:
        known = ", ".join(columns) or "none"
        raise ValueError(f"no label of 2 to {MOST_CLASSES} classes (labels: {known}): name one")
    sample = _sample(subject.held_out, EXPLAINED)
    task = question(sample.labels, names, source=sample.source)
    count = max(2, int(0.4 * task.known.sum()))
    table = embed_pictures(subject.model, sample)
    split = choose_rows(task, sample.files, (count,), (0,))
    fresh = untrained_features(subject.model, sample, seed=0).factors
    found = explain_labels(table.factors, task, split, untrained=[fresh], seeds=(0,))
    note = f"Explained on {len(sample):,} images, one seed: {', '.join(names)}."
    return [blocks.prose(note), *share_blocks(found, share_chart(found)[0])]


def suitable_label(pictures: ImageSet) -> tuple[str, ...]:
    """The first column of text with few classes that each have enough images; empty for none."""
    for name, column in pictures.labels.items():
        if column.dtype.kind not in "USO":
            continue
        values, counts = np.unique(column[column != ""].astype(str), return_counts=True)
        if 2 <= len(values) <= MOST_CLASSES and counts.min() >= FEWEST_OF_A_CLASS:
            return (name,)
    return ()


def _sample(pictures: ImageSet, most: int) -> ImageSet:
    """At most so many images, evenly through the set."""
    if len(pictures) <= most:
        return pictures
    return pictures.select(np.linspace(0, len(pictures) - 1, most).round().astype(int))
