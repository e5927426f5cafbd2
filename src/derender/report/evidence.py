"""What can be told of a trained model once pictures are at hand: sections for the page of its run.

The data examined, held-out pictures taken apart, films, scores beside controls, the disentanglement card, and
which factor answers a label. Every part looks at few pictures, so that a page takes minutes; the commands
``derender evaluate`` and ``explain`` measure with more. A part that cannot be made is named with its reason.
Leaves out what a run wrote itself (``run``).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8

from derender.baselines.controls import untrained_features
from derender.data import GroundTruth, PictureSet, as_float
from derender.data.doctor import doctor
from derender.evaluation import evaluate_factors, evaluate_geometry, evaluate_reconstruction, mean_picture
from derender.evaluation.disentanglement import disentangle
from derender.evaluation.linear_task import choose_rows
from derender.features import embed_pictures
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

EXAMINED, SCORED, CARD, EXPLAINED = 1_500, 200, 200, 400  # pictures each part looks at, at most
SHOWN, FILMED = 5, 2
FILM_WIDTH = 256
FEWEST_OF_A_CLASS, MOST_CLASSES = 10, 12

Progress = Callable[[int, int], object]


@dataclass(frozen=True)
class Evidence:
    """Sections for a page, and what could not be made.

    Attributes:
        sections: in reading order.
        failed: a sentence for each part that is missing, with the reason.
    """

    sections: Sequence[Section]
    failed: Sequence[str] = ()


@dataclass(frozen=True)
class AtHand:
    """A model and pictures to tell about.

    Attributes:
        model: trained.
        pictures: all there are, at the model's size.
        held_out: those of them the model was not trained on, or all where they are of another set.
        which: what ``held_out`` is, in words.
        truth: rendered pictures with exact maps, if there are any.
        labels: columns to ask which factor answers them.
    """

    model: Derenderer
    pictures: PictureSet
    held_out: PictureSet
    which: str
    truth: GroundTruth | None = None
    labels: Sequence[str] = ()


def look_at_data(pictures: PictureSet) -> list[Html]:
    """The doctor's findings on a sample of the pictures."""
    sample = _sample(pictures, EXAMINED)
    size = f"All {len(sample):,} pictures" if len(sample) == len(pictures) else f"{len(sample):,} pictures"
    note = blocks.prose(f"{pictures.describe()}. {size} were examined, identical copies left out before.")
    return [note, *doctor_blocks(doctor(sample))]


def gather(hand: AtHand, progress: Progress | None = None) -> Evidence:
    """Everything that can be told; ``progress`` is called with (parts done, parts in all)."""
    parts: dict[tuple[str, str], Callable[[], list[Html]]] = {
        ("The data", "Data"): lambda: look_at_data(hand.pictures),
        ("Pictures it did not learn from, taken apart", "Taken apart"): lambda: decompositions(hand),
        ("Light and view moved", "Films"): lambda: moved(hand),
        ("Scores beside controls", "Scores"): lambda: scores(hand),
        ("Does each feature hold its own factor?", "Card"): lambda: card(hand),
        ("Which factor answers", "Explained"): lambda: explained(hand),
    }
    sections, failed = [], []
    for done, ((title, short), make) in enumerate(parts.items()):
        if progress is not None:
            progress(done, len(parts))
        try:
            made = make()
        except ValueError as reason:
            failed.append(f"{title}: {reason}")
            continue
        sections.append(Section(title, made, short))
    if progress is not None:
        progress(len(parts), len(parts))
    return Evidence(sections, failed)


def decompositions(hand: AtHand) -> list[Html]:
    """A few pictures in their factors, rendered again, in other light and from another side."""
    sample = _sample(hand.held_out.require(1, "a decomposition"), SHOWN)
    drawn = decompose_images(hand.model, as_float(sample.images).to(hand.model.device))
    caption = f"{hand.which}, evenly chosen by their order. Every column is made from the picture alone."
    return [
        blocks.image_grid(drawn.columns, [Path(name).name for name in sample.files], caption, COLUMN_MEANING),
        blocks.definitions(COLUMN_MEANING),
    ]


def moved(hand: AtHand) -> list[Html]:
    """Short films of some of the same images."""
    sample = _sample(hand.held_out.require(1, "a film"), SHOWN).select(slice(FILMED))
    names = [Path(name).name for name in sample.files]
    caption = "Only light or camera moves. Empty parts are those that the frontal view does not show."
    return [looping_films(hand.model, sample.images, names, caption)]


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


def scores(hand: AtHand) -> list[Html]:
    """Reconstruction beside the mean picture and, on rendered data, geometry beside its controls."""
    sample = _sample(hand.held_out.require(1, "a score"), SCORED)
    again = evaluate_reconstruction(hand.model, sample.images, mean=mean_picture(hand.pictures.images))
    tables = [again.table()]
    if hand.truth is not None:
        truth = hand.truth
        tables.insert(0, evaluate_geometry(hand.model, truth).table())
        if truth.albedo is not None and truth.light is not None and truth.camera is not None:
            tables.insert(1, evaluate_factors(hand.model, truth).table())
    made = [blocks.prose(f"{hand.which}; few of them, so that this page takes minutes.")]
    for table in tables:
        made += [blocks.prose(f"{table.columns[0].name}: {table.verdict(0)}."), blocks.table(table)]
    if hand.truth is None:
        made.append(
            blocks.prose(
                "These pictures have no exact depth, so whether the geometry is right cannot be scored here."
            )
        )
    return made


def card(hand: AtHand) -> list[Html]:
    """The disentanglement card from one seed, without scores by dimension."""
    sample = _sample(hand.held_out, CARD)
    found = disentangle(hand.model, sample, seeds=(0,), dimensions=None, swap_images=min(64, len(sample)))
    sheet = blocks.image(
        matrix_sheet(card_matrices(found.result)), "matrices of the features: correlation, CKA, swap test"
    )
    return [
        blocks.prose(f"{'. '.join(found.notes[:2])}."),
        *(blocks.table(table) for table in found.tables[:3]),
        blocks.folded("Matrices", sheet),
    ]


def explained(hand: AtHand) -> list[Html]:
    """Shares of the factors in the answers of a probe, beside controls."""
    columns = hand.held_out.labels
    names = tuple(hand.labels) or label_to_ask(hand.held_out)
    if not names:
        told = ", ".join(columns) or "none"
        raise ValueError(f"no label of 2 to {MOST_CLASSES} classes to ask for (labels: {told}); add --label")
    sample = _sample(hand.held_out, EXPLAINED)
    task = question(sample.labels, names, source=sample.source)
    count = max(2, int(0.4 * task.known.sum()))
    table = embed_pictures(hand.model, sample)
    split = choose_rows(task, sample.files, (count,), (0,))
    fresh = untrained_features(hand.model, sample, seed=0).factors
    found = explain_labels(table.factors, task, split, untrained=[fresh], seeds=(0,))
    asked = f"Asked of {len(sample):,} pictures, one seed: {', '.join(names)}."
    return [blocks.prose(asked), *share_blocks(found, share_chart(found)[0])]


def label_to_ask(pictures: PictureSet) -> tuple[str, ...]:
    """The first column of text whose classes are few and each has pictures enough; empty for none."""
    for name, column in pictures.labels.items():
        if column.dtype.kind not in "USO":
            continue
        values, counts = np.unique(column[column != ""].astype(str), return_counts=True)
        if 2 <= len(values) <= MOST_CLASSES and counts.min() >= FEWEST_OF_A_CLASS:
            return (name,)
    return ()


def _sample(pictures: PictureSet, most: int) -> PictureSet:
    """At most so many pictures, evenly through the set."""
    if len(pictures) <= most:
        return pictures
    return pictures.select(np.linspace(0, len(pictures) - 1, most).round().astype(int))
