"""`derender evaluate robustness`: does a probe's answer hold under other light and from other sides?"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from derender.cli import options, scoring
from derender.cli.console import progress_bar, refuse_existing_file, result
from derender.cli.gathered import gathered

FORMS = (".svg", ".png", ".html")
SHOWN_SCORES = {"accuracy": "accuracy", "balanced": "balanced_accuracy"}


def _count(option: str, text: str, least: int = 1) -> typer.models.OptionInfo:
    return typer.Option(option, min=least, metavar="N", help=text)


@dataclass(frozen=True)
class TrialOptions:
    """The images of a trial; named as in `derender.evaluation.robustness`."""

    pictures: Annotated[
        str | None,
        typer.Option(
            "--pictures",
            help="faces or cars: generated. render: IMAGES, re-rendered. truth: IMAGES of known angles.",
            metavar="faces|cars|render|truth",
        ),
    ] = None
    groups: Annotated[
        str | None, typer.Option("--groups", help="Label of IMAGES whose rows stay on one side of the split.")
    ] = None
    test_fraction: Annotated[
        float, typer.Option("--test-fraction", min=0.01, max=0.99, help="Tested share of re-rendered IMAGES.")
    ] = 0.3
    people: Annotated[int, _count("--people", "Number of generated people (or cars).", 2)] = 40
    learned: Annotated[int, _count("--learned", "Generated training images of each.")] = 8
    tested: Annotated[int, _count("--tested", "Generated test images of each at each angle.")] = 2
    head: Annotated[
        str, typer.Option("--head", help="Probe: logistic, linear (the paper's), centred or k-NN.")
    ] = "logistic"
    seeds: Annotated[int, _count("--seeds", "Number of training subsets.")] = 5
    untrained_seeds: scoring.UntrainedSeeds = 5


Models = Annotated[
    list[str], typer.Option("--model", "-m", help="A model; the first renders.", metavar="[NAME=]MODEL")
]
Axes = Annotated[str, typer.Option("--axes", help="yaw, pitch (camera), light, light-pitch; with commas.")]
Angles = Annotated[str, typer.Option("--angles", help="Degrees off the front, growing, with commas between.")]
Score = Annotated[str, typer.Option("--score", help="Shown: accuracy or balanced. --json has both.")]
Out = Annotated[
    Path | None, typer.Option("--out", "-o", help="Also draw the curves: .svg, .png, .html.", metavar="FILE")
]


def register(group: typer.Typer) -> None:
    group.command(
        "robustness", epilog="Example: derender evaluate robustness --model runs/faces --out curves.svg"
    )(robustness)


@gathered
def robustness(
    images: options.DataOptions,
    trial: TrialOptions,
    labels: scoring.Labels,
    computed: scoring.Computed,
    published: scoring.Published,
    model: Models,
    factors: scoring.Factors = "geometry,albedo",
    axes: Axes = "yaw,light",
    angles: Angles = "0,15,30,45,60,75",
    score: Score = "accuracy",
    out: Out = None,
) -> None:
    """Does a probe learned in ordinary light and view hold in others? Curves over angles, area 1 is best.

    Images are generated, so that light and view are known; or IMAGES are re-rendered by the first model; or
    IMAGES have known angles.
    """
    from derender import evaluation

    published.check()
    if out is not None:
        if out.suffix.lower() not in FORMS:
            raise ValueError(f"--out {out} must end in {', '.join(FORMS)}: a chart, or a page with tables")
        refuse_existing_file(out, published.force)
    if score not in SHOWN_SCORES:
        raise ValueError(f"unknown --score {score!r}: choose accuracy or balanced")
    models = scoring.named_paths(model, "--model")
    if twice := [name for name, paths in models.items() if len(paths) > 1]:
        raise ValueError(f"two models have the name {twice[0]!r}: give each its own")
    with progress_bar("scoring") as progress:
        scores = evaluation.robustness(
            {name: paths[0] for name, paths in models.items()}, images.optional_address, **images.how,
            **vars(trial), **vars(labels), **vars(computed), score=SHOWN_SCORES[score],
            axes=[name.strip() for name in axes.split(",") if name.strip()],
            angles=scoring.numbers_of(angles, "--angles"), factors=scoring.names_of(factors),
            progress=progress,
        )  # fmt: skip
    published.show(scores.tables, {**scores.values, "models": model}, scores.notes)
    if out is not None:
        from derender.report.robustness import write_curves

        write_curves(scores.result, SHOWN_SCORES[score], ", ".join(model), out)
        result(f"curves in {out}", published.json_file)
