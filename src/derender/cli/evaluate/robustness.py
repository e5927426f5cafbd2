"""`derender evaluate robustness`: does a probe's answer hold under other light and from other sides?"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

from derender.cli import options, scoring
from derender.cli.console import progress_bar, result

PICTURES = "faces or cars: generated. render: IMAGES, re-rendered. truth: IMAGES of known angles."
MODEL = "A model; the first renders."
Model = Annotated[list[str], typer.Option("--model", "-m", metavar="[NAME=]MODEL", help=MODEL)]
Axes = Annotated[str, typer.Option(help="yaw, pitch, light, light-pitch; with commas.")]
Angles = Annotated[str, typer.Option(help="Growing degrees off the front.")]
Score = Annotated[Literal["accuracy", "balanced"], typer.Option(help="The score shown; --json has both.")]
OUT = "Also draw the curves: .svg, .png, .html."
Out = Annotated[Path | None, typer.Option("--out", "-o", metavar="FILE", help=OUT)]


@dataclass(frozen=True)
class TrialOptions:
    """The images of a trial; named as in `derender.evaluation.robustness`."""

    pictures: Annotated[str | None, typer.Option(metavar="faces|cars|render|truth", help=PICTURES)] = None
    groups: scoring.Groups = None
    test_fraction: Annotated[float, scoring.share(help="Tested share of re-rendered IMAGES.")] = 0.3
    people: Annotated[int, scoring.number(min=2, help="Number of generated people (or cars).")] = 40
    learned: Annotated[int, scoring.number(help="Generated training images of each.")] = 8
    tested: Annotated[int, scoring.number(help="Generated test images of each at each angle.")] = 2
    head: Annotated[str, typer.Option(help="Probe: logistic, linear, centred or k-NN.")] = "logistic"
    seeds: Annotated[int, scoring.number(help="Number of training subsets.")] = 5
    untrained_seeds: scoring.UntrainedSeeds = 5


def robustness(
    images: options.DataOptions, trial: TrialOptions, labels: scoring.Labels, computed: scoring.Computed,
    published: scoring.Published, model: Model, factors: scoring.Factors = "geometry,albedo",
    axes: Axes = "yaw,light", angles: Angles = "0,15,30,45,60,75", score: Score = "accuracy", out: Out = None,
) -> None:  # fmt: skip
    """Does a probe learned in ordinary light and view hold in others? Curves over angles, area 1 is best.

    Images are generated, so that light and view are known; or IMAGES are re-rendered by the first model; or
    IMAGES have known angles.
    """
    from derender import evaluation

    published.check(out, [".svg", ".png", ".html"])
    shown = "balanced_accuracy" if score == "balanced" else score
    with progress_bar("scoring") as progress:
        scores = evaluation.robustness(
            scoring.single_paths(model, "--model"), images.optional_address, **images.how, **vars(trial),
            **vars(labels), **vars(computed), score=shown, axes=scoring.names_of(axes) or (),
            angles=scoring.numbers_of(angles, "--angles"), factors=scoring.names_of(factors),
            progress=progress,
        )  # fmt: skip
    published.publish(scores, models=model)
    if out is not None:
        from derender.report.protocols import write_curves

        write_curves(scores.result, shown, ", ".join(model), out)
        result(f"curves in {out}", published.json_file)
