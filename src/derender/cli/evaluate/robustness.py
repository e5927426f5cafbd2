"""`derender evaluate robustness`: does a probe's answer hold under other light and from other sides?"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from derender.cli import options, scoring
from derender.cli.options import command, option

MODEL = "A model; the first renders."
PICTURES = "faces or cars: generated. render: IMAGES, re-rendered. truth: IMAGES of known angles."


@dataclass(frozen=True)
class TrialOptions:
    """The images of a trial; named as in `derender.evaluation.robustness`."""

    pictures: str | None = option(None, PICTURES, metavar="faces|cars|render|truth")
    groups: scoring.Groups = None
    test_fraction: float = scoring.share(0.3, "Tested share of re-rendered IMAGES.")
    people: int = scoring.number(40, "Number of generated people (or cars).", min=2)
    learned: int = scoring.number(8, "Generated training images of each.")
    tested: int = scoring.number(2, "Generated test images of each at each angle.")
    head: str = option("logistic", "Probe: logistic, linear, centred or k-NN.")
    seeds: int = scoring.number(5, "Number of training subsets.")
    untrained_seeds: scoring.UntrainedSeeds = 5


@command("robustness", "evaluate robustness --model runs/faces --out curves.svg", scoring.evaluate)
def robustness(
    images: options.DataOptions, trial: TrialOptions, labels: scoring.Labels, computed: scoring.Computed,
    published: scoring.Published, factors: scoring.Factors = "geometry,albedo",
    model: list[str] = option(..., MODEL, "--model", "-m", metavar="[NAME=]MODEL"),
    axes: str = option("yaw,light", "yaw, pitch, light, light-pitch; with commas."),
    angles: str = option("0,15,30,45,60,75", "Growing degrees off the front."),
    score: Literal["accuracy", "balanced"] = option("accuracy", "The score shown; --json has both."),
    out: Path | None = option(None, "Also draw the curves: .svg, .png.", "--out", "-o", metavar="FILE"),
) -> None:  # fmt: skip
    """Does a probe learned in ordinary light and view hold in others? Curves over angles, area 1 is best.

    Images are generated, so that light and view are known; or IMAGES are re-rendered by the first model; or
    IMAGES have known angles.
    """
    published.check(out, ends=[".svg", ".png"])
    shown = "balanced_accuracy" if score == "balanced" else score
    models = scoring.named_paths(model, "--model")
    if twice := [name for name, paths in models.items() if len(paths) > 1]:
        raise ValueError(f"two models have the name {twice[0]!r}: give each its own")
    scores = scoring.measured(
        "robustness", {name: path for name, (path,) in models.items()}, images.optional_address,
        **images.how, **vars(trial), **vars(labels), **vars(computed), score=shown,
        axes=scoring.names_of(axes) or (), angles=scoring.numbers_of(angles, "--angles"),
        factors=scoring.names_of(factors),
    )  # fmt: skip
    published.publish(scores, models=model, half=images.half)
    if out is not None:
        from derender.report.protocols import write_curves

        write_curves(scores.result, shown, out)
        published.result(f"curves in {out}")
