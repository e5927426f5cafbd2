"""`derender refine`: a copy of a model that predicts at once what test-time optimisation finds."""

from typing import Annotated

import typer

from derender.cli.console import notice, progress_bar, report_images
from derender.cli.gathered import gathered
from derender.cli.options import OutModel, Output, PartOfImages, Seed, TrainedModel

Changes = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE",
        help="images (how many are seen), batch_size, learning_rate, fitted (images), fit_steps, worst, "
        "rendered, exchanged, picture_weight, reframed (share shown in other crops, as reframe.farther=1.9), "
        "strange; the size of perturbations, as perturb.light_deg; for features those of derender whiten.",
    ),
]  # fmt: skip


def register(app: typer.Typer) -> None:
    app.command(
        "refine",
        epilog="Example: derender refine photos/ --model runs/mine --part train --out refined",
    )(refine)


@gathered
def refine(
    images: PartOfImages, model: TrainedModel, out: OutModel, output: Output, settings: Changes = None,
    seed: Seed = 0,
) -> None:  # fmt: skip
    """Write a copy of a model that predicts at once the scenes that test-time optimisation finds slowly.

    Scenes are fitted to these images once, without labels; then the encoders learn to predict them, from the
    images and from renderings of the fitted scenes under other lighting and viewpoints (knowledge
    distillation). Every tenth image is held out: errors are measured on those.
    """
    from derender import learn

    output.refuse_existing(out)
    with progress_bar("refining") as report:
        made = learn.refine(
            model.model, images.address, out=out, settings=settings or (), seed=seed, device=model.device,
            overwrite=output.force, **images.how, on_images=report_images, progress=report,
        )  # fmt: skip
    errors = made.scores["errors"]
    notice(
        f"{made.scores['held_out']} held-out images: reconstructed with an error of {errors['now']:.4f}, "
        f"before {errors['before']:.4f}, fitted {errors['fitted']:.4f}"
    )
    for name, gap in made.scores["gaps"].items():
        notice(
            f"{name}: {gap['now']:.2f} mean deviations away from fitted scenes, before {gap['before']:.2f}"
        )
    output.result(f"model {made.folder}")
    output.write(made.values())
