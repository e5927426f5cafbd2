"""The demo's model beside the one that comes with derender: the same pictures, the same moves, labelled.

That one has seen rendered faces too, but of another family and for longer; each picture says whose it is.
Leaves out everything about the demo's own model (``page``).
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import UInt8

from derender.data import as_float
from derender.demo.story import SHIPPED, DemoResult
from derender.evaluation.score_table import ScoreTable
from derender.model import Derenderer
from derender.report import blocks, colours, films
from derender.report.figures import Decomposition, decomposition
from derender.report.score_table import geometry_table
from derender.report.viewer.examples import rendered_examples

FRAMES, MOVES = 16, "the light goes round, the head turns"
SHOWN = 4
COLUMNS = ("reconstruction", "normals", "albedo", "another view")


def shipped_blocks(result: DemoResult, rows: np.ndarray) -> list[blocks.Html]:
    """The section: faces of the family that it knows, then the demo's own faces by both models."""
    shipped, own = result.shipped, result.model
    known = np.stack([example.picture for example in rendered_examples(SHIPPED, shipped.image_size)])
    same_size = shipped.image_size == own.image_size
    made: list[blocks.Html] = [
        blocks.prose(
            blocks.code(SHIPPED),
            " was trained beforehand, on rendered faces of another family, and is there after installing: ",
            blocks.code(f'derender.load("{SHIPPED}")'),
            ". Neither model saw any of these pictures in training.",
        ),
        _films(shipped, known[:SHOWN]),
        blocks.image_grid(
            _columns(known[::2], shipped, own if same_size else None),
            [f"rendered face {number}" for number in range(1, len(known) + 1, 2)],
            f"Faces of the family that {SHIPPED} was trained on"
            + (", by both models." if same_size else "; this run's model takes pictures of another size."),
            show_names=False,
        ),
    ]
    if result.shipped_geometry is not None:
        made += [
            blocks.image_grid(
                _columns(result.truth.images[rows[:SHOWN]], shipped, own),
                [f"unseen face {number}" for number in range(1, min(SHOWN, len(rows)) + 1)],
                "Faces of the family that this run was trained on, by both models. Most have hair or beards: "
                f"{SHIPPED} has seen bald heads only.",
                show_names=False,
            ),
            blocks.table(beside_table(result)),
        ]
    return made


def beside_table(result: DemoResult) -> ScoreTable:
    """Geometry of both models on the demo's unseen faces, beside the controls."""
    assert result.shipped_geometry is not None, "scored only where the sizes agree"
    own = geometry_table(result.geometry, len(result.truth))
    other = geometry_table(result.shipped_geometry, len(result.truth))
    models = [
        replace(own.rows[0], name="this run"),
        replace(other.rows[0], name=SHIPPED, note="comes with derender; has not seen faces of this family"),
    ]
    return replace(own, caption=f"{own.caption}: both models", rows=[*models, *own.rows[1:]])


def _columns(
    images: UInt8[np.ndarray, "n 3 h w"], shipped: Derenderer, own: Derenderer | None
) -> dict[str, colours.Images]:
    """Input, then what each model makes of it."""
    columns: dict[str, colours.Images] = {"input": colours.pictures(images)}
    for name, model in (("this run", own), (SHIPPED, shipped)):
        if model is not None:
            drawn = _taken_apart(images, model).columns
            columns |= {f"{column}, {name}": drawn[column] for column in COLUMNS}
    return columns


def _taken_apart(images: UInt8[np.ndarray, "n 3 h w"], model: Derenderer) -> Decomposition:
    pictures = as_float(images)
    with torch.no_grad():
        scene = model.decompose(pictures)
    return decomposition(pictures, scene, model.render, model.fov_deg)


def _films(model: Derenderer, images: UInt8[np.ndarray, "n 3 h w"]) -> blocks.Html:
    with torch.no_grad():
        scene = model.decompose(as_float(images))
    items = []
    for index in range(len(images)):
        both = films.side_by_side(
            [
                films.relighting(scene[index], model.render, frames=FRAMES),
                films.rotation(scene[index], model.render, frames=FRAMES),
            ]
        )
        alt = f"rendered face {index + 1}, by {SHIPPED}: {MOVES}"
        items.append((blocks.film(films.animated_png(both), both[FRAMES // 4], alt, 236), MOVES))
    return blocks.figure(blocks.row_of(items), f"Made by {SHIPPED} from one picture each.")
