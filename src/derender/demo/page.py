"""The demo's report: images, and numbers beside controls, of the trained and of the bundled model.

Every sentence about a number is made by comparing it. Leaves out computing (``story``) and the words of the
page (``report/templates/demo.html``).
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8

from derender import __version__
from derender.data import as_float
from derender.data.source import evenly_spaced
from derender.demo.story import BUNDLED, STAGES, DemoResult
from derender.evaluation.scenes import optimised
from derender.evaluation.score_table import ScoreTable
from derender.evaluation.truth import predicted_depth
from derender.model import Derenderer
from derender.presets import MODEL_PRESETS
from derender.report import colours
from derender.report.decomposition import COLUMN_MEANING, decompose_images
from derender.report.page import DIRECTIONS, Page
from derender.report.run import looping_films, loss_charts
from derender.report.viewer.images import rendered_examples
from derender.scene.normals import normals_from_depth
from derender.training.config import PRESETS
from derender.training.run_folder import read_metrics

CLUSTERS_SHOWN, MEMBERS_SHOWN, INPUTS_SHOWN, BUNDLED_SHOWN = 5, 12, 10, 4
COLUMNS_BESIDE = ("reconstruction", "normals", "albedo", "another view")


def demo_page(result: DemoResult) -> Page:
    """The whole report of one demo."""
    rows = evenly_spaced(len(result.truth), result.settings.shown)  # chosen before anything was scored
    images, tables = result.truth.images[rows], score_tables(result)
    filmed = images[: result.settings.films]
    names = [f"unseen face {row + 1}" for row in range(len(images))]
    examples = rendered_examples(BUNDLED, result.bundled.image_size)
    known = np.stack([one.picture for one in examples]).transpose(0, 3, 1, 2)
    faces = [f"rendered face {number + 1}" for number in range(len(known))]
    models = {"this run": result.model, BUNDLED: result.bundled}
    step = max(1, len(result.seen) // INPUTS_SHOWN)
    same_size = result.model.image_size == result.bundled.image_size
    values = {
        "result": result,
        "usual": PRESETS[result.config.preset].images,
        "tables": tables,
        "tile": _tile,
        "inputs": colours.pictures(result.seen.images[::step][:INPUTS_SHOWN]),
        "names": names,
        "meaning": COLUMN_MEANING,
        "decomposed": decompose_images(result.model, as_float(images)).columns,
        "films": looping_films(result.model, filmed, names[: len(filmed)]),
        "bundled": BUNDLED,
        "same_size": same_size,
        "bundled_films": looping_films(
            result.bundled, known[:BUNDLED_SHOWN], [f"{name}, by {BUNDLED}" for name in faces[:BUNDLED_SHOWN]]
        ),
        "known_names": faces[: len(known[::2])],
        "beside_known": _beside(models if same_size else {BUNDLED: result.bundled}, known[::2]),
        "beside": _beside(models, images[:BUNDLED_SHOWN]) if same_size else {},
        "geometry": _beside_truth(result, rows),
        "people": len(np.unique(result.identities)),
        "clusters": _clusters(result),
        "charts": loss_charts(read_metrics(result.trained.folder)),
        "stages": [stage for stage in STAGES if stage in result.seconds],
        "threads": torch.get_num_threads(),
        "presets": ", ".join(MODEL_PRESETS),
    }
    return Page(
        "demo.html",
        "Images decomposed",
        "derender was given faces without a single label and learned to decompose each one into geometry, "
        "albedo, light and camera, by reconstructing it. One run on this machine made this page; every "
        "number was measured in it.",
        values,
        f"derender {__version__}. The faces are generated; they show no real person.",
    )


def score_tables(result: DemoResult) -> dict[str, ScoreTable]:
    """Every table of the page by name."""
    own, steps = result.geometry.table(), result.settings.fit_steps
    notes = {BUNDLED: "bundled with derender; trained on 12,000 other faces of this family"}
    first = replace(own.rows[0], name=f"this run, {steps} steps per image" if steps else "this run")
    others = {name: one.table().rows[0] for name, one in result.geometry_beside.items()}
    beside = [replace(row, name=name, note=notes.get(name, "")) for name, row in others.items()]
    return {
        "geometry": replace(own, rows=[first, *beside, *own.rows[1:]]),
        "factors": result.factors.table(),
        "reconstruction": result.reconstruction.table(),
        "clustering": result.clustering,
    }


def _tile(table: ScoreTable, column: int, *controls: str) -> tuple[str, str]:
    """The first row's number, and those of some controls."""
    head = table.columns[column]
    cells = {row.name: head.text(row.cells[column]) for row in table.rows}
    beside = ", ".join(f"{name} {cells[name]}" for name in controls)
    return cells[table.rows[0].name], f"{beside}; {DIRECTIONS[head.best]}"


def _beside(
    models: Mapping[str, Derenderer], images: UInt8[np.ndarray, "n 3 h w"]
) -> dict[str, colours.Images]:
    """Inputs, then what each model makes of them."""
    columns = {"input": colours.pictures(images)}
    for name, model in models.items():
        drawn = decompose_images(model, as_float(images)).columns
        columns |= {f"{column}, {name}": drawn[column] for column in COLUMNS_BESIDE}
    return columns


def _beside_truth(result: DemoResult, rows: np.ndarray) -> dict[str, colours.Images]:
    truth, model = result.truth, optimised(result.model, result.settings.fit_steps)
    assert truth.normal is not None and truth.albedo is not None  # as of every generated face
    images, mask = truth.images[rows], truth.mask[rows]
    depth, covered = predicted_depth(model, images)
    both = (covered & torch.as_tensor(mask)).float()
    normals = normals_from_depth(torch.where(covered, depth, 1.0), model.fov_deg)
    with torch.no_grad():
        scene = model.decompose(as_float(images))
        ambient = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand_as(scene.light)
        flat = model.render(scene.with_parameters(light=ambient))
    return {
        "input": colours.pictures(images),
        "predicted depth": colours.depth_maps(depth, both),
        "true depth": colours.depth_maps(truth.depth[rows], mask),
        "predicted normals": colours.normal_maps(normals, both),
        "true normals": colours.normal_maps(truth.normal[rows], mask),
        "predicted albedo": colours.pictures(flat.image, both),
        "true albedo": colours.pictures(truth.albedo[rows], mask),
    }


def _clusters(result: DemoResult) -> list[tuple[list[Any], str]]:
    """Faces of some clusters from the purest to the most mixed, with a caption each."""
    groups = []
    for cluster in np.unique(result.clusters):
        members = np.flatnonzero(result.clusters == cluster)
        counts = np.unique(result.identities[members], return_counts=True)[1]
        groups.append((counts.max() / len(members), members))
    groups.sort(key=lambda group: (-group[0], -len(group[1])))
    shown = []
    for purity, members in (groups[pick] for pick in evenly_spaced(len(groups), CLUSTERS_SHOWN)):
        some = members[:MEMBERS_SHOWN]
        faces = zip(colours.pictures(result.truth.images[some]), result.identities[some], strict=True)
        row = [(face, f"a face of {name}", name) for face, name in faces]
        shown.append((row, f"{len(members)} images, {100 * purity:.0f} % of one person"))
    return shown
