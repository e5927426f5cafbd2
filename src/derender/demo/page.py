"""The demo's report: images, and numbers beside controls, of the trained and of the bundled model.

Every sentence about a number is made by comparing it. Leaves out computing (``story``).
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import UInt8

from derender import __version__
from derender.data import as_float
from derender.demo.story import BUNDLED, STAGES, DemoResult
from derender.evaluation.clustering import clustering_table
from derender.evaluation.depth import predicted_depth
from derender.evaluation.score_table import ScoreTable
from derender.model import Derenderer
from derender.presets import MODEL_PRESETS
from derender.report import blocks, colours
from derender.report.decomposition import COLUMN_MEANING, decompose_images
from derender.report.evidence import looping_films
from derender.report.page import Page, Section
from derender.report.run import loss_charts
from derender.report.viewer.neighbours import rendered_examples
from derender.scene.normals import normals_from_depth
from derender.training.config import PRESETS
from derender.training.run_folder import read_metrics

CLUSTERS_SHOWN, MEMBERS_SHOWN, INPUTS_SHOWN, BUNDLED_SHOWN = 5, 12, 10, 4
COLUMNS_BESIDE = ("reconstruction", "normals", "albedo", "another view")
ENDED = {
    "images": "the planned number of images",
    "minutes": "the time limit",
    "patience": "no more improvement on held-out images",
    "collapse": "the watcher",
}
EMPTY_PARTS = "Empty parts are those that the frontal view does not show."


def demo_page(result: DemoResult) -> Page:
    """The whole report of one demo."""
    rows = shown_rows(result)
    images, tables = result.truth.images[rows], score_tables(result)
    films = looping_films(
        result.model,
        images[: result.settings.films],
        [f"unseen face {row + 1}" for row in range(min(len(rows), result.settings.films))],
        f"From one image each: only light or camera moves, everything else stays. {EMPTY_PARTS}",
    )
    return Page(
        "Images decomposed",
        "derender was given faces without a single label and learned to decompose each one into geometry, "
        "albedo, light and camera, by reconstructing it. One run on this machine made this page; every "
        "number was measured in it.",
        [
            Section("Results", _summary(result, tables), "Summary"),
            Section("Unseen faces, decomposed", _decomposed(result.model, images), "Decomposed"),
            Section("Move the light, turn the head", [films], "Moved"),
            Section("The bundled model", _bundled(result, images, tables), "Beside it"),
            Section("Is the geometry real?", _geometry(result, rows, tables), "Geometry"),
            Section(
                "Clusters of people, without labels", _clusters(result, tables["clustering"]), "Clusters"
            ),
            Section("Training", _training(result), "Training"),
            Section("With your own images", _next_steps(), "Next"),
        ],
        f"derender {__version__}. The faces are generated; they show no real person.",
    )


def score_tables(result: DemoResult) -> dict[str, ScoreTable]:
    """Every table of the page by name."""
    own = result.geometry.table()
    tables = {"geometry": own}
    if result.bundled_geometry is not None:
        other = result.bundled_geometry.table().rows[0]
        note = "bundled with derender; has not seen faces of this family"
        models = [replace(own.rows[0], name="this run"), replace(other, name=BUNDLED, note=note)]
        tables["beside"] = replace(own, caption=f"{own.caption}: both models", rows=[*models, *own.rows[1:]])
    return tables | {
        "factors": result.factors.table(),
        "reconstruction": result.reconstruction.table(),
        "clustering": clustering_table(result.clustering),
    }


def shown_rows(result: DemoResult) -> np.ndarray:
    """Unseen images for the page, evenly through the set: chosen before anything was scored."""
    count = min(result.settings.shown, len(result.truth))
    return np.linspace(0, len(result.truth) - 1, count).round().astype(int)


def _summary(result: DemoResult, tables: Mapping[str, ScoreTable]) -> list[blocks.Html]:
    tiles = {
        "Depth error, SIDE x 100": _tile(tables["geometry"], 0, ("average depth", "plane")),
        "Normals, mean angle in degrees": _tile(tables["geometry"], 1, ("average depth", "plane")),
        "Identity, cluster accuracy": _tile(tables["clustering"], 0, ("chance",)),
        "Reconstruction, L1": _tile(tables["reconstruction"], 0, ("mean image",)),
    }
    usual, seen = PRESETS[result.config.preset].images, result.trained.images
    length = f"Training saw {seen:,} images (repeats counted)"
    if seen < usual:
        length += f"; an ordinary run of the same preset sees {usual:,}"
    verdicts = {
        "Depth": tables["geometry"].verdict(0),
        "Normals": tables["geometry"].verdict(1),
        "Clusters by identity": tables["clustering"].verdict(0),
        "Reconstruction": tables["reconstruction"].verdict(0),
    }
    warnings = [
        blocks.prose(blocks.strong("Warning of the watcher: "), finding.text)
        for finding in result.trained.findings
    ]
    inputs = colours.pictures(result.seen.images[:: max(1, len(result.seen) // INPUTS_SHOWN)][:INPUTS_SHOWN])
    return [
        blocks.key_figures(tiles),
        blocks.prose(f"All on {len(result.truth):,} generated faces of people not in training. {length}."),
        *warnings,
        blocks.definitions(verdicts),
        blocks.figure(
            blocks.row_of([(blocks.image(image, "a training face", 86), "") for image in inputs]),
            f"Training images: {len(result.seen):,} generated faces, in varied lighting and viewpoint.",
        ),
    ]


def _tile(table: ScoreTable, column: int, controls: tuple[str, ...]) -> tuple[str, str]:
    """The first row's number, and those of some controls."""
    head = table.columns[column]
    cells = {row.name: head.text(row.cells[column]) for row in table.rows}
    better = "lower is better" if head.best == "low" else "higher is better"
    return cells[table.rows[0].name], ", ".join(
        [f"{name} {cells[name]}" for name in controls]
    ) + f"; {better}"


def _decomposed(model: Derenderer, images: UInt8[np.ndarray, "n 3 h w"]) -> list[blocks.Html]:
    caption = "Each row is one unseen image, evenly chosen through the set before anything was scored."
    columns = decompose_images(model, as_float(images)).columns
    return [_grid(columns, "unseen face", caption, COLUMN_MEANING), blocks.definitions(COLUMN_MEANING)]


def _grid(
    columns: Mapping[str, colours.Images],
    name: str,
    caption: str,
    meaning: Mapping[str, str] | None = None,
) -> blocks.Html:
    """A grid whose rows are numbered faces."""
    names = [f"{name} {number + 1}" for number in range(len(next(iter(columns.values()))))]
    return blocks.image_grid(columns, names, caption, meaning, show_names=False)


def _bundled(
    result: DemoResult, images: UInt8[np.ndarray, "n 3 h w"], tables: Mapping[str, ScoreTable]
) -> list[blocks.Html]:
    """Faces of the family that the bundled model knows, then the demo's own faces by both models."""
    own, bundled = result.model, result.bundled
    known = np.stack([example.picture for example in rendered_examples(BUNDLED, bundled.image_size)])
    models = {BUNDLED: bundled}
    both = "; this run's model takes images of another size."
    if own.image_size == bundled.image_size:
        models, both = {"this run": own, BUNDLED: bundled}, ", by both models."

    def beside(shown: UInt8[np.ndarray, "n 3 h w"]) -> dict[str, colours.Images]:
        """Inputs, then what each model makes of them."""
        columns: dict[str, colours.Images] = {"input": colours.pictures(shown)}
        for name, model in models.items():
            drawn = decompose_images(model, as_float(shown)).columns
            columns |= {f"{column}, {name}": drawn[column] for column in COLUMNS_BESIDE}
        return columns

    shown = known[:BUNDLED_SHOWN]
    names = [f"rendered face {number + 1}, by {BUNDLED}" for number in range(len(shown))]
    made = [
        blocks.prose(
            blocks.code(BUNDLED),
            " was trained beforehand, on rendered faces of another family, and is installed with derender: ",
            blocks.code(f'derender.load("{BUNDLED}")'),
            ". Neither model saw any of these images in training.",
        ),
        looping_films(bundled, shown, names, f"Made by {BUNDLED} from one image each."),
        _grid(
            beside(known[::2]), "rendered face", f"Faces of the family that {BUNDLED} was trained on{both}"
        ),
    ]
    if "beside" in tables:
        caption = (
            "Faces of the family that this run was trained on, by both models. Most have hair or beards: "
            f"{BUNDLED} has seen bald heads only."
        )
        made += [
            _grid(beside(images[:BUNDLED_SHOWN]), "unseen face", caption),
            blocks.table(tables["beside"]),
        ]
    return made


def _geometry(result: DemoResult, rows: np.ndarray, tables: Mapping[str, ScoreTable]) -> list[blocks.Html]:
    return [
        blocks.prose(
            "The faces were generated, so their true depth is known. ",
            blocks.strong("SIDE"),
            " is the error of depth up to scale, ",
            blocks.strong("MAD"),
            " the mean angle between predicted and true surface directions; both are measured inside "
            "the face and are 0 for perfect geometry. The average depth of all these faces is a hard "
            "control: it knows the shape of a face.",
        ),
        blocks.table(tables["geometry"]),
        _grid(
            _beside_truth(result, rows),
            "unseen face",
            "Predicted and true surface in the view of the image, inside the true outline. "
            "Depth is brighter where nearer, each column on its own scale.",
        ),
        blocks.table(tables["factors"]),
        blocks.table(tables["reconstruction"]),
    ]


def _beside_truth(result: DemoResult, rows: np.ndarray) -> dict[str, colours.Images]:
    truth, model = result.truth, result.model
    images = truth.images[rows]
    depth, covered = predicted_depth(model, images)
    mask = truth.mask[rows]
    both = (covered & torch.as_tensor(mask)).float()
    filled = torch.where(covered, depth, torch.ones_like(depth))
    columns = {
        "input": colours.pictures(images),
        "predicted depth": colours.depth_maps(depth, both),
        "true depth": colours.depth_maps(truth.depth[rows], mask),
        "predicted normals": colours.normal_maps(normals_from_depth(filled, model.fov_deg), both),
    }
    if truth.normal is not None:
        columns["true normals"] = colours.normal_maps(truth.normal[rows], mask)
    with torch.no_grad():
        scene = model.decompose(as_float(images))
        ambient = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand_as(scene.light)
        flat = model.render(scene.with_parameters(light=ambient))
    columns["predicted albedo"] = colours.pictures(flat.image, both)
    if truth.albedo is not None:
        columns["true albedo"] = colours.pictures(truth.albedo[rows], mask)
    return columns


def _clusters(result: DemoResult, table: ScoreTable) -> list[blocks.Html]:
    people = len(np.unique(result.identities))
    figures = []
    for members, caption in _purest_to_most_mixed(result):
        faces = zip(colours.pictures(result.truth.images[members]), result.identities[members], strict=True)
        row = [(blocks.image(image, f"a face of {name}", 64), name) for image, name in faces]
        figures.append(blocks.figure(blocks.row_of(row), caption))
    return [
        blocks.prose(
            f"The unseen faces show {people} people in changing light, view and expression. "
            f"Ward clustering sorted their geometry and albedo features into {people} groups."
        ),
        blocks.definitions({f"{table.columns[column].name}": table.verdict(column) for column in (0, 1, 2)}),
        blocks.table(table),
        blocks.folded("Some of the clusters", *figures),
    ]


def _purest_to_most_mixed(result: DemoResult) -> list[tuple[np.ndarray, str]]:
    """Members of some clusters from the purest to the most mixed, with a caption each."""
    groups = []
    for cluster in np.unique(result.clusters):
        members = np.flatnonzero(result.clusters == cluster)
        counts = np.unique(result.identities[members], return_counts=True)[1]
        groups.append((counts.max() / len(members), members))
    groups.sort(key=lambda group: (-group[0], -len(group[1])))
    picks = np.unique(np.linspace(0, len(groups) - 1, CLUSTERS_SHOWN).round().astype(int))
    return [
        (members[:MEMBERS_SHOWN], f"{len(members)} images, {100 * purity:.0f} % of one person")
        for purity, members in (groups[pick] for pick in picks)
    ]


def _training(result: DemoResult) -> list[blocks.Html]:
    trained = result.trained
    facts = {
        **{stage: f"{result.seconds[stage]:.0f} s" for stage in STAGES if stage in result.seconds},
        "images seen": f"{trained.images:,}",
        "images per second": f"{trained.images_per_second:.0f}",
        "training ended by": ENDED.get(trained.stopped, trained.stopped),
        "preset": result.config.preset,
        "perceptual features": result.config.objective.perceptual,
        "seed": result.seed,
        "threads": torch.get_num_threads(),
    }
    return [*loss_charts(read_metrics(trained.folder)), blocks.facts(facts)]


def _next_steps() -> list[blocks.Html]:
    return [
        blocks.prose(
            "Any folder or zip of images of one kind of thing, roughly centred and aligned, will do; "
            f"no labels are read. Presets: {', '.join(MODEL_PRESETS)}."
        ),
        blocks.listing(
            "derender train photos/ --preset small --out runs/mine\n"
            "derender decompose --model runs/mine photo.jpg --out decomposed/\n"
            "derender embed photos/ --model runs/mine --out features.parquet"
        ),
    ]
