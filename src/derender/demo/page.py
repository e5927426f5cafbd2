"""The demo's report: what came out, in pictures and in numbers beside controls.

Every sentence about a number is made by comparing it; none is true by hope.
"""

from collections.abc import Sequence

import numpy as np
import torch

from derender import __version__
from derender.data import as_float
from derender.demo.shipped import beside_table, shipped_blocks
from derender.demo.story import STAGES, DemoResult
from derender.evaluation.geometry import predicted_depth
from derender.evaluation.score_table import ScoreTable
from derender.presets import MODEL_PRESETS
from derender.report import blocks, colours, films
from derender.report.figures import COLUMN_MEANING, Decomposition, decomposition
from derender.report.page import Page, Section
from derender.report.run import loss_charts
from derender.report.score_table import clustering_table, factor_table, geometry_table, reconstruction_table
from derender.scene.normals import normals_from_depth
from derender.training.config import PRESETS
from derender.training.run_folder import read_metrics

CLUSTERS_SHOWN, MEMBERS_SHOWN, INPUTS_SHOWN = 5, 12, 10
ENDED = {
    "images": "the planned number of pictures",
    "minutes": "the time limit",
    "patience": "no more improvement on held-out pictures",
    "collapse": "the watcher",
}
FRAMES, MOVES = 16, "the light goes round, the head turns"


def demo_page(result: DemoResult) -> Page:
    """The whole report of one demo."""
    rows = shown_rows(result)
    pictures = as_float(result.truth.images[rows])
    with torch.no_grad():
        scene = result.model.decompose(pictures)
    drawn = decomposition(pictures, scene, result.model.render, result.model.fov_deg)
    tables = score_tables(result)
    return Page(
        "Pictures taken apart",
        "derender was given faces without a single label and learned to take each one apart into geometry, "
        "albedo, light and camera, by rendering it again. One run on this machine made this page; every "
        "number was measured in it.",
        [
            Section("What came out", _summary(result, tables), "Summary"),
            Section("Faces it never saw, taken apart", _decomposed(drawn), "Taken apart"),
            Section("Move the light, turn the head", _films(result, scene), "Moved"),
            Section("The model that comes with derender", shipped_blocks(result, rows), "Beside it"),
            Section("Is the geometry real?", _geometry(result, rows, tables), "Geometry"),
            Section("Who is who, without labels", _clusters(result, tables["clustering"]), "Clusters"),
            Section("How it was trained", _training(result), "Training"),
            Section("With your own pictures", _next_steps(), "Next"),
        ],
        f"derender {__version__}. The faces are generated and show nobody.",
    )


def score_tables(result: DemoResult) -> dict[str, ScoreTable]:
    """Every table of the page by name."""
    pictures = len(result.truth)
    controls = list(result.clustering)[1:]
    beside = {} if result.shipped_geometry is None else {"beside": beside_table(result)}
    return {
        "geometry": geometry_table(result.geometry, pictures),
        **beside,
        "factors": factor_table(result.factors, pictures),
        "reconstruction": reconstruction_table(result.reconstruction, pictures),
        "clustering": clustering_table(result.clustering, controls),
    }


def shown_rows(result: DemoResult) -> np.ndarray:
    """Unseen pictures for the page, evenly through the set: chosen before anything was scored."""
    count = min(result.settings.shown, len(result.truth))
    return np.linspace(0, len(result.truth) - 1, count).round().astype(int)


def _summary(result: DemoResult, tables: dict[str, ScoreTable]) -> list[blocks.Html]:
    geometry, reconstruction, clustering = result.geometry, result.reconstruction, tables["clustering"]
    chance = clustering.rows[-1].cells[0]
    tiles = {
        "Depth error, SIDE x 100": (
            f"{100 * geometry.model.side:.2f}",
            f"average depth {100 * geometry.average_depth.side:.2f}, plane {100 * geometry.plane.side:.2f}; "
            "lower is better",
        ),
        "Normals, mean angle": (
            f"{geometry.model.mad_deg:.1f}°",
            f"average depth {geometry.average_depth.mad_deg:.1f}°, plane {geometry.plane.mad_deg:.1f}°; "
            "lower is better",
        ),
        "Identity, cluster accuracy": (
            clustering.columns[0].text(clustering.rows[0].cells[0]),
            f"chance {clustering.columns[0].text(chance)}; higher is better",
        ),
        "Rendered again, L1": (
            f"{reconstruction.model.l1:.3f}",
            f"mean picture {reconstruction.mean_picture.l1:.3f}; lower is better",
        ),
    }
    usual, seen = PRESETS[result.config.preset].images, result.trained.images
    length = f"It saw {seen:,} pictures (repeats counted)"
    if seen < usual:
        length += f"; an ordinary run of the same preset sees {usual:,}: read this as a beginning"
    verdicts = {
        "Depth": tables["geometry"].verdict(0),
        "Normals": tables["geometry"].verdict(1),
        "Clusters by identity": clustering.verdict(0),
        "Rendered again": tables["reconstruction"].verdict(0),
    }
    warnings = [
        blocks.prose(blocks.strong("The watcher says: "), finding.text) for finding in result.trained.findings
    ]
    inputs = colours.pictures(result.seen.images[:: max(1, len(result.seen) // INPUTS_SHOWN)][:INPUTS_SHOWN])
    return [
        blocks.key_figures(tiles),
        blocks.prose(
            f"All on {len(result.truth):,} generated faces of people that training never met. {length}."
        ),
        *warnings,
        blocks.definitions(verdicts),
        blocks.figure(
            blocks.row_of([(blocks.image(image, "a training face", 86), "") for image in inputs]),
            f"What it learned from: {len(result.seen):,} generated faces, in varied light and view.",
        ),
    ]


def _decomposed(drawn: Decomposition) -> list[blocks.Html]:
    names = [f"unseen face {number}" for number in range(1, len(drawn) + 1)]
    caption = "Each row is one unseen picture, evenly chosen through the set before anything was scored."
    return [
        blocks.image_grid(drawn.columns, names, caption, COLUMN_MEANING, show_names=False),
        blocks.definitions(COLUMN_MEANING),
    ]


def _films(result: DemoResult, scene) -> list[blocks.Html]:
    items = []
    for index in range(min(result.settings.films, len(scene))):
        relit = films.relighting(scene[index], result.model.render, frames=FRAMES)
        turned = films.rotation(scene[index], result.model.render, frames=FRAMES)
        both = films.side_by_side([relit, turned])
        film = blocks.film(
            films.animated_png(both), both[FRAMES // 4], f"unseen face {index + 1}: {MOVES}", 236
        )
        items.append((film, MOVES))
    return [
        blocks.figure(
            blocks.row_of(items),
            "From one picture each: only light or camera moves, everything else stays. "
            "Empty parts are those that the frontal view does not show.",
        )
    ]


def _geometry(result: DemoResult, rows: np.ndarray, tables: dict[str, ScoreTable]) -> list[blocks.Html]:
    return [
        blocks.prose(
            "The faces were generated, so their true depth is known. ",
            blocks.strong("SIDE"),
            " is the error of depth up to scale, ",
            blocks.strong("MAD"),
            " the mean angle between found and true surface directions; both are measured inside "
            "the face and shrink to 0 for perfect geometry. The average depth of all these faces is a hard "
            "control: it knows what a face is like.",
        ),
        blocks.table(tables["geometry"]),
        blocks.image_grid(
            _beside_truth(result, rows),
            [f"unseen face {number}" for number in range(1, len(rows) + 1)],
            "Found and true surface in the view of the picture, inside the true outline. "
            "Depth is brighter where nearer, each column on its own scale.",
            show_names=False,
        ),
        blocks.table(tables["factors"]),
        blocks.table(tables["reconstruction"]),
    ]


def _beside_truth(result: DemoResult, rows: np.ndarray) -> dict[str, colours.Images]:
    truth, model = result.truth, result.model
    depth, covered = predicted_depth(model, truth.images[rows])
    true_mask = torch.as_tensor(truth.mask[rows])
    both = (covered & true_mask).float()
    filled = torch.where(covered, depth, torch.ones_like(depth))
    columns = {
        "input": colours.pictures(truth.images[rows]),
        "depth found": colours.depth_maps(depth, both),
        "true depth": colours.depth_maps(truth.depth[rows], truth.mask[rows]),
        "normals found": colours.normal_maps(normals_from_depth(filled, model.fov_deg), both),
    }
    if truth.normal is not None:
        columns["true normals"] = colours.normal_maps(truth.normal[rows], truth.mask[rows])
    with torch.no_grad():
        scene = model.decompose(as_float(truth.images[rows]))
        white = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand_as(scene.light)
        flat = model.render(scene.with_parameters(light=white))
    columns["albedo found"] = colours.pictures(flat.image, both)
    if truth.albedo is not None:
        columns["true albedo"] = colours.pictures(truth.albedo[rows], truth.mask[rows])
    return columns


def _clusters(result: DemoResult, table: ScoreTable) -> list[blocks.Html]:
    people = len(np.unique(result.identities))
    shown = [
        blocks.figure(
            blocks.row_of(
                [
                    (blocks.image(image, f"a face of {name}", 64), name)
                    for image, name in zip(
                        colours.pictures(result.truth.images[members]),
                        result.identities[members],
                        strict=True,
                    )
                ]
            ),
            caption,
        )
        for members, caption in _purest_and_worst(result)
    ]
    return [
        blocks.prose(
            f"The unseen faces show {people} people in changing light, view and expression. "
            f"Ward clustering sorted their geometry and albedo features into {people} groups."
        ),
        blocks.definitions({f"{table.columns[column].name}": table.verdict(column) for column in (0, 1, 2)}),
        blocks.table(table),
        blocks.folded("Some of the clusters", *shown),
    ]


def _purest_and_worst(result: DemoResult) -> list[tuple[np.ndarray, str]]:
    """Clusters from the purest to the most mixed, with a caption each."""
    groups = []
    for cluster in np.unique(result.clusters):
        members = np.flatnonzero(result.clusters == cluster)
        counts = np.unique(result.identities[members], return_counts=True)[1]
        groups.append((counts.max() / len(members), len(members), members))
    groups.sort(key=lambda group: (-group[0], -group[1]))
    picks = np.unique(np.linspace(0, len(groups) - 1, CLUSTERS_SHOWN).round().astype(int))
    return [
        (
            groups[pick][2][:MEMBERS_SHOWN],
            f"{groups[pick][1]} pictures, {100 * groups[pick][0]:.0f} % of one person",
        )
        for pick in picks
    ]


def _training(result: DemoResult) -> list[blocks.Html]:
    trained = result.trained
    minutes = {stage: f"{result.seconds[stage]:.0f} s" for stage in STAGES if stage in result.seconds}
    facts = {
        **minutes,
        "pictures seen": f"{trained.images:,}",
        "pictures per second": f"{trained.images_per_second:.0f}",
        "training ended by": ENDED.get(trained.stopped, trained.stopped),
        "preset": result.config.preset,
        "perceptual features": result.config.objective.perceptual,
        "seed": result.seed,
        "threads": torch.get_num_threads(),
    }
    return [*loss_charts(read_metrics(trained.folder)), blocks.facts(facts)]


def _next_steps() -> list[blocks.Html]:
    presets: Sequence[str] = tuple(MODEL_PRESETS)
    return [
        blocks.prose(
            "Any folder or zip of pictures of one kind of thing, roughly centred and aligned, will do; "
            "no labels are read. "
            f"Presets: {', '.join(presets)}."
        ),
        blocks.listing(
            "derender train --data photos/ --preset small --out runs/mine\n"
            "derender decompose --model runs/mine photo.jpg --out apart/\n"
            "derender embed --model runs/mine --data photos/ --out features.parquet"
        ),
    ]
