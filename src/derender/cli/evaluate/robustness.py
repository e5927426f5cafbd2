"""`derender evaluate robustness`: does what a probe learned hold under other light and from other sides?"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from derender.cli import feature_rows, options, scoring
from derender.cli.console import notice, progress_bar, refuse_existing_file, result
from derender.cli.gathered import gathered

if TYPE_CHECKING:
    from derender.evaluation.feature_rows import FeatureRow
    from derender.evaluation.memory import Memory
    from derender.evaluation.robust import RobustnessComparison, Trial
    from derender.evaluation.robust.trial import Axis
    from derender.features import FeatureTable
    from derender.model import Derenderer

FORMS = (".svg", ".png", ".html")
WAYS = ("faces", "cars", "render", "truth")

Models = Annotated[
    list[str],
    typer.Option("--model", "-m", help="A model; the first one renders.", metavar="[NAME=]MODEL"),
]
Ways = Annotated[
    str | None,
    typer.Option(
        "--pictures",
        help="faces or cars: generated. render: --data, rendered again. truth: --data of known angles.",
        metavar="faces|cars|render|truth",
    ),
]
Data = Annotated[
    str | None,
    typer.Option("--data", "-d", help="Pictures to render again, or of known angles.", metavar="PATH"),
]
Label = Annotated[
    list[str] | None,
    typer.Option("--label", "-l", help="What is asked; by default identity, of cars their class."),
]
Axes = Annotated[str, typer.Option("--axes", help="yaw, pitch (camera), light, light-pitch; with commas.")]
Levels = Annotated[str, typer.Option("--angles", help="Degrees off the front, growing, with commas between.")]
People = Annotated[int, typer.Option("--people", min=2, metavar="N", help="Of generated pictures (or cars).")]
Learned = Annotated[
    int, typer.Option("--learned", min=1, metavar="N", help="Generated pictures of each to learn from.")
]
Tested = Annotated[
    int, typer.Option("--tested", min=1, metavar="N", help="Generated pictures of each tested at each angle.")
]
Seeds = Annotated[int, typer.Option("--seeds", min=1, metavar="N", help="Draws of what is learned from.")]
Head = Annotated[str, typer.Option("--head", help="Probe: logistic, linear (the paper's), centred or k-NN.")]
Score = Annotated[str, typer.Option("--score", help="Shown: accuracy or balanced. --json has both.")]
Groups = Annotated[
    str | None,
    typer.Option("--groups", help="With --data: label whose rows stay on one side of the split."),
]
TestFraction = Annotated[
    float, typer.Option("--test-fraction", min=0.01, max=0.99, help="Of --data rendered again: tested.")
]
Out = Annotated[
    Path | None,
    typer.Option("--out", "-o", help="Also draw the curves: .svg, .png, or a page.", metavar="FILE"),
]
Size = Annotated[
    int | None, typer.Option("--limit", min=1, metavar="N", help="At most so many pictures of --data.")
]


@dataclass(frozen=True)
class Shown:
    """What is shown of which pictures, to be asked what."""

    pictures: Ways = None
    data: Data = None
    dataset: options.Dataset = "auto"
    limit: Size = None
    label: Label = None
    attributes: scoring.Attributes = False
    min_count: feature_rows.MinCount = 1
    max_count: feature_rows.MaxCount = None
    groups: Groups = None
    test_fraction: TestFraction = 0.3
    axes: Axes = "yaw,light"
    angles: Levels = "0,15,30,45,60,75"
    people: People = 40
    learned: Learned = 8
    tested: Tested = 2

    @property
    def way(self) -> str:
        """Where pictures come from, checked against the other options."""
        from derender.data import suggestion

        way = self.pictures or ("faces" if self.data is None else "render")
        if way not in WAYS:
            raise ValueError(
                f"--pictures {way!r} is unknown{suggestion(way, WAYS)}: choose {', '.join(WAYS)}"
            )
        generated = way in ("faces", "cars")
        if generated == (self.data is not None):
            what = "are generated and take no --data" if generated else "need --data: the pictures"
            raise ValueError(f"--pictures {way} {what}")
        if generated and (self.attributes or self.groups or len(self.label or ()) > 1):
            raise ValueError(f"--pictures {way} are asked one --label; --attributes and --groups need --data")
        return way


def register(group: typer.Typer) -> None:
    group.command(
        "robustness",
        epilog="Example: derender evaluate robustness --model runs/faces --out curves.svg",
    )(robustness)


@gathered
def robustness(
    model: Models,
    shown: Shown,
    computed: scoring.Computed,
    published: scoring.Published,
    factors: feature_rows.Factors = "geometry,albedo",
    seeds: Seeds = 5,
    head: Head = "logistic",
    score: Score = "accuracy",
    untrained_seeds: feature_rows.UntrainedSeeds = 5,
    out: Out = None,
) -> None:
    """Does what was learned in ordinary light and view hold in others? Curves over angles, area 1 is best.

    Pictures are generated, so that light and view are known; or --data, taken apart and rendered again by
    the first model; or --data whose true angles are known.
    """
    published.check()
    if out is not None:
        if out.suffix.lower() not in FORMS:
            raise ValueError(f"--out {out} must end in {', '.join(FORMS)}: a chart, or a page with tables")
        refuse_existing_file(out, published.force)
    if score not in ("accuracy", "balanced"):
        raise ValueError(f"unknown --score {score!r}: choose accuracy or balanced")
    score = {"balanced": "balanced_accuracy"}.get(score, score)
    way = shown.way

    from derender.cli.models import open_model
    from derender.evaluation.linear_probes import check_head
    from derender.evaluation.robust import chosen_axes, compare_robustness
    from derender.evaluation.score_table import verdict

    check_head(head)
    axes = chosen_axes(
        [name.strip() for name in shown.axes.split(",") if name.strip()],
        way if way in ("faces", "cars") else None,
    )
    nets = {
        name: open_model(one_path(name, paths), computed.device)
        for name, paths in feature_rows.named_paths(model, "--model").items()
    }
    memory = feature_rows.memory_in(computed.cache)
    trial = make_trial(shown, way, axes, next(iter(nets.values())), computed, memory)
    notice(f"{len(trial.images):,} pictures: {trial.how}")
    rows = all_rows(trial, nets, factors, computed.from_seed(untrained_seeds), computed.device, memory)
    with progress_bar("probing", "probes") as report:
        found = compare_robustness(
            {row.name: [table.concatenate(row.factors) for table in row.tables] for row in rows},
            trial,
            tuple(computed.from_seed(seeds)),
            controls=[row.name for row in rows if row.control],
            head=head,
            resample_count=computed.resamples,
            seed=computed.seed,
            memory=memory,
            progress=report,
        )
    notes = [f"{curve.title}: {verdict(curve.rows[score][0], 'area')}" for curve in found.curves]
    values = {"pictures": way, "data": shown.data, "models": model, **found.numbers()}
    published.show(found.tables(score), values, [*notes, scoring.remembered(memory)])
    if out is not None:
        draw(found, score, ", ".join(model), out)
        result(f"curves in {out}", published.json_file)


def one_path(name: str, paths: Sequence[str]) -> str:
    """The model of a name; two are an error."""
    if len(paths) > 1:
        raise ValueError(f"two models have the name {name!r}: give each its own")
    return paths[0]


def make_trial(
    shown: Shown,
    way: str,
    axes: "Sequence[Axis]",
    net: "Derenderer",
    computed: scoring.Computed,
    memory: "Memory",
) -> "Trial":
    """The pictures, who learns and who is tested."""
    from derender.evaluation.robust import (
        KINDS,
        Recipe,
        checked_levels,
        generated_trial,
        rendered_trial,
        true_angle_trial,
    )

    levels = checked_levels(feature_rows.whole_numbers(shown.angles, "--angles"), axes)
    if way in KINDS:
        label = shown.label[0] if shown.label else KINDS[way].label
        recipe = Recipe(way, label, shown.people, shown.learned, shown.tested, net.image_size, computed.seed)
        with progress_bar("generating") as report:
            return generated_trial(recipe, axes, levels, memory=memory, progress=report)
    import numpy as np

    from derender.evaluation.feature_rows import FeatureRow, prepare
    from derender.evaluation.linear_task import divide_rows, task_of
    from derender.features import FeatureTable, table_labels

    assert shown.data is not None
    pictures = feature_rows.Pictures(shown.data, shown.dataset, shown.limit).at(net.image_size)
    columns = FeatureTable(pictures.files, {"none": np.zeros((len(pictures), 1))}, table_labels(pictures))
    row = FeatureRow("pictures", (columns,))
    names = feature_rows.chosen_labels([row], default_label(shown, columns), shown.attributes, least=2)
    groups = [shown.groups] if shown.groups else []
    ready = prepare([row], names, min_count=shown.min_count, max_count=shown.max_count, keep=groups)
    pictures = feature_rows.aligned(pictures, ready.files)
    task = task_of(ready.labels)
    if way == "truth":
        return true_angle_trial(pictures, task, axes)
    sides = ready.kept[shown.groups] if shown.groups else None
    learn, test = divide_rows(
        task, ready.files, test_fraction=shown.test_fraction, partition=ready.partition, groups=sides
    )
    with progress_bar("rendering again") as report:
        return rendered_trial(
            net, pictures, task, learn, test, axes, levels, groups=sides, memory=memory, progress=report
        )


def all_rows(
    trial: "Trial",
    nets: "dict[str, Derenderer]",
    factors: str,
    seeds: Sequence[int],
    device: str,
    memory: "Memory",
) -> "list[FeatureRow]":
    """Factors together, each factor by itself, other models' factors together; then the controls."""
    from derender.evaluation.feature_rows import FeatureRow

    chosen, rows, pictures = feature_rows.factors_of(factors), [], trial.pictures
    for name, net in nets.items():
        table = feature_rows.embedded(net, pictures, memory, f"embedding {name}")
        joined = " + ".join(chosen or table.factors)
        prefix = f"{name}: " if len(nets) > 1 else ""
        rows.append(FeatureRow(f"{prefix}{joined}", (table,), chosen))
        if len(rows) == 1:
            single = [one for one in table.factors if one != joined]
            rows += [FeatureRow(f"{prefix}{one}", (table,), (one,)) for one in single]
    settings = next(iter(nets.values())).settings
    learned = pictures.select(trial.learned)
    return [*rows, *feature_rows.control_rows(pictures, settings, chosen, seeds, device, memory, learned)]


def default_label(shown: Shown, columns: "FeatureTable") -> list[str] | None:
    """The label asked for; identity, else class, where none is."""
    if shown.label or shown.attributes:
        return shown.label
    return next(([name] for name in ("identity", "class") if name in columns.labels), None)


def draw(found: "RobustnessComparison", score: str, model: str, out: Path) -> None:
    """The chart, or the page."""
    from derender.report.page import write_whole
    from derender.report.robustness import robustness_chart, robustness_page

    if out.suffix.lower() == ".html":
        robustness_page(found, model, score).write(out)
        return
    svg, png = robustness_chart(found, score)
    write_whole(out, png if out.suffix.lower() == ".png" else svg.encode())
